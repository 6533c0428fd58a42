// The three programs: points, thick lines, pictures. What moves is drawn over a copy of the background's colours and is
// hidden by the background's depths.

const HIDING = `#version 300 es
    precision mediump float;
    uniform highp sampler2D depths;  // of the background
    uniform bool isHidden;  // behind the background
    out vec4 pixel;
    bool behind(highp float depth) { return isHidden && depth > texelFetch(depths, ivec2(gl_FragCoord.xy), 0).r; }`;

const POINTS = {
  vertex: `#version 300 es
    layout(location = 0) in vec3 position;
    layout(location = 1) in vec3 color;
    layout(location = 2) in vec3 quality;  // rank of the confidence, step of the depth, logarithm of the width
    uniform mat4 matrix;
    uniform float size;  // of the narrowest point at distance 1, in pixels
    uniform float doublings;  // from the narrowest point to the widest
    uniform float smallest;
    uniform float rim;  // pixels that are added
    uniform vec2 limits;  // least rank, largest step
    uniform vec4 blend;  // towards this colour, by this much
    uniform float pixels;  // of a length at distance 1
    out vec3 shade;
    flat out float roundness;
    flat out highp vec2 reach;  // distance from the eye, and half the width
    void main() {
      gl_Position = matrix * vec4(position, 1.0);
      gl_PointSize = clamp(size * exp2(doublings * quality.z) / gl_Position.w, smallest, 64.0) + rim;
      if (quality.x < limits.x || quality.y > limits.y) gl_Position = vec4(2.0, 2.0, 2.0, 1.0);
      shade = mix(color, blend.rgb, blend.a);
      roundness = gl_PointSize > 4.0 ? 0.25 : 1.0;  // small points are squares: discs would leave holes
      reach = vec2(gl_Position.w, 0.5 * (gl_PointSize - rim) * gl_Position.w / pixels);
    }`,
  fragment: `${HIDING}
    in vec3 shade;
    flat in float roundness;
    flat in highp vec2 reach;
    uniform highp float near;
    void main() {
      vec2 side = gl_PointCoord - 0.5;
      // A disc bulges towards the eye: where discs overlap, every pixel shows the point whose middle is nearest to it.
      highp float depth = 1.0 - near / (reach.x + 4.0 * dot(side, side) * reach.y);
      if (dot(side, side) > roundness || behind(depth)) discard;
      gl_FragDepth = depth;
      pixel = vec4(shade, 1.0);
    }`,
};

const LINES = {
  vertex: `#version 300 es
    layout(location = 0) in vec3 from;
    layout(location = 1) in vec3 to;
    layout(location = 2) in vec3 color;
    uniform mat4 matrix;
    uniform vec2 screen;  // pixels
    uniform float width;
    uniform float near;
    uniform vec4 blend;
    out vec3 shade;
    void main() {
      vec4 a = matrix * vec4(from, 1.0), b = matrix * vec4(to, 1.0);
      if (a.w < near) a = mix(a, b, (near - a.w) / max(b.w - a.w, 1e-6));
      if (b.w < near) b = mix(b, a, (near - b.w) / max(a.w - b.w, 1e-6));
      vec2 along = (b.xy / b.w - a.xy / a.w) * screen;
      vec2 across = vec2(-along.y, along.x) / max(length(along), 1e-6) * width / screen;
      vec4 end = (gl_VertexID & 1) == 0 ? a : b;
      gl_Position = end + vec4(across * ((gl_VertexID & 2) == 0 ? 1.0 : -1.0) * end.w, 0.0, 0.0);
      if (a.w < near && b.w < near) gl_Position = vec4(2.0, 2.0, 2.0, 1.0);
      shade = mix(color, blend.rgb, blend.a);
    }`,
  fragment: `${HIDING}
    in vec3 shade;
    void main() { if (behind(gl_FragCoord.z)) discard; pixel = vec4(shade, 1.0); }`,
};

const PICTURES = {
  vertex: `#version 300 es
    layout(location = 0) in vec3 position;
    layout(location = 1) in vec2 place;
    uniform mat4 matrix;
    out vec2 uv;
    void main() { gl_Position = matrix * vec4(position, 1.0); uv = place; }`,
  fragment: `${HIDING}
    uniform sampler2D sheet;
    in vec2 uv;
    void main() { if (behind(gl_FragCoord.z)) discard; pixel = vec4(texture(sheet, uv).rgb, 1.0); }`,
};

function program(gl, { vertex, fragment }) {
  const made = gl.createProgram();
  for (const [type, source] of [[gl.VERTEX_SHADER, vertex], [gl.FRAGMENT_SHADER, fragment]]) {
    const shader = gl.createShader(type);
    gl.shaderSource(shader, source);
    gl.compileShader(shader);
    if (!gl.getShaderParameter(shader, gl.COMPILE_STATUS)) throw new Error(gl.getShaderInfoLog(shader));
    gl.attachShader(made, shader);
  }
  gl.linkProgram(made);
  const names = Array.from({ length: gl.getProgramParameter(made, gl.ACTIVE_UNIFORMS) }, (_, i) => gl.getActiveUniform(made, i).name);
  return { made, uniforms: Object.fromEntries(names.map((name) => [name, gl.getUniformLocation(made, name)])) };
}
