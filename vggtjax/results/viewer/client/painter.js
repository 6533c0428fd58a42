// Draws the parts of results into the bound framebuffer.

const LINE_BYTES = 36; // from, to, colour
const FRUSTUM_EDGES = [[0, 1], [0, 2], [0, 3], [0, 4], [1, 2], [2, 3], [3, 4], [4, 1]]; // centre, then the corners

class Painter {
  constructor(gl) {
    this.gl = gl;
    this.points = program(gl, POINTS);
    this.lines = program(gl, LINES);
    this.pictures = program(gl, PICTURES);
    gl.enable(gl.DEPTH_TEST);
    this.depths = null;
  }

  // depths: the texture of the background's depths, which hide what is drawn from now on; null while drawing it.
  hideBehind(depths) {
    this.depths = depths;
    this.gl.activeTexture(this.gl.TEXTURE1);
    this.gl.bindTexture(this.gl.TEXTURE_2D, depths);
    this.gl.activeTexture(this.gl.TEXTURE0);
  }

  use({ made, uniforms }, view) {
    const { gl } = this;
    gl.useProgram(made);
    gl.uniformMatrix4fv(uniforms.matrix, false, view.matrix);
    gl.uniform1i(uniforms.depths, 1);
    gl.uniform1i(uniforms.isHidden, this.depths ? 1 : 0);
  }

  // limits: least rank of the confidence, largest step of the depth, both in [0, 1].
  // size: of a point, over its width. blend: a colour, and how much of it the points take on. rim: pixels by which points
  // are wider than they are; those of a rim leave no depths, so all that is drawn later lies over them.
  drawPoints(model, first, count, view, { limits, size, smallest = 1, rim = 0, blend = [0, 0, 0, 0] }) {
    if (count <= 0) return;
    const { gl, points: { uniforms } } = this;
    this.use(this.points, view);
    gl.bindVertexArray(model.points);
    const [narrowest, doublings] = model.result.widths;
    const pixels = view.height / (2 * view.tall); // of a length at distance 1
    gl.uniform1f(uniforms.pixels, pixels);
    gl.uniform1f(uniforms.near, view.near);
    gl.uniform1f(uniforms.size, size * narrowest * pixels);
    gl.uniform1f(uniforms.doublings, doublings);
    gl.uniform1f(uniforms.smallest, smallest);
    gl.uniform1f(uniforms.rim, rim);
    gl.uniform2f(uniforms.limits, ...limits);
    gl.uniform4f(uniforms.blend, ...blend);
    gl.depthMask(rim === 0);
    gl.drawArrays(gl.POINTS, first, count);
    gl.depthMask(true);
  }

  drawLines(model, { first, count }, view, width, blend = [0, 0, 0, 0]) {
    if (count <= 0) return;
    const { gl, lines: { uniforms } } = this;
    this.use(this.lines, view);
    gl.bindVertexArray(model.lines);
    gl.bindBuffer(gl.ARRAY_BUFFER, model.lineBuffer);
    for (let i = 0; i < 3; i++) gl.vertexAttribPointer(i, 3, gl.FLOAT, false, LINE_BYTES, first * LINE_BYTES + 12 * i);
    gl.uniform2f(uniforms.screen, view.width, view.height);
    gl.uniform1f(uniforms.width, width);
    gl.uniform4f(uniforms.blend, ...blend);
    gl.uniform1f(uniforms.near, view.near);
    gl.drawArraysInstanced(gl.TRIANGLE_STRIP, 0, 4, count);
  }

  drawPicture(model, frame, view) {
    const { gl } = this;
    this.use(this.pictures, view);
    gl.bindVertexArray(model.pictures);
    gl.bindTexture(gl.TEXTURE_2D, model.sheet);
    gl.drawArrays(gl.TRIANGLE_FAN, 4 * frame, 4);
  }
}

// A result on the graphics card.
class Model {
  constructor(gl, result) {
    Object.assign(this, { gl, result });
    this.frusta = spacedFrames(result);
    this.makePoints();
    this.makeLines();
    this.makePictures();
  }

  makePoints() {
    const { gl, result } = this;
    this.points = gl.createVertexArray();
    gl.bindVertexArray(this.points);
    attribute(gl, 0, result.positions, 3, gl.FLOAT, false);
    this.colorBuffer = attribute(gl, 1, result.colors[0].values, 3, gl.UNSIGNED_BYTE, true);
    attribute(gl, 2, result.quality, 3, gl.UNSIGNED_BYTE, true);
  }

  // color: an entry of result.colors, of colours or of numbers in [0, 255] with their ramp.
  paint(color) {
    const { gl } = this;
    let values = color.values;
    if (color.ramp) {
      values = new Uint8Array(3 * color.values.length);
      for (let i = 0; i < values.length; i++) values[i] = color.ramp[3 * color.values[Math.floor(i / 3)] + (i % 3)];
    }
    gl.bindBuffer(gl.ARRAY_BUFFER, this.colorBuffer);
    gl.bufferData(gl.ARRAY_BUFFER, values, gl.STATIC_DRAW);
  }

  makeLines() {
    const { gl, result } = this;
    const lines = [];
    const corner = (frame, i) => result.corners.subarray(15 * frame + 3 * i, 15 * frame + 3 * i + 3);
    const shade = (frame) => Array.from(result.frameColors.subarray(3 * frame, 3 * frame + 3), (value) => value / 255);
    const group = (add) => {
      const first = lines.length / 9;
      add();
      return { first, count: lines.length / 9 - first };
    };
    this.frustumLines = Array.from({ length: result.frames }, (_, frame) =>
      group(() => FRUSTUM_EDGES.forEach(([a, b]) => lines.push(...corner(frame, a), ...corner(frame, b), ...shade(frame)))));
    this.path = group(() => {
      for (let frame = 1; frame < result.frames; frame++) lines.push(...corner(frame - 1, 0), ...corner(frame, 0), ...shade(frame));
    });
    this.trackLines = Array.from({ length: result.frames }, (_, frame) => group(() => frame && this.addTracks(lines, frame)));
    this.lines = gl.createVertexArray();
    gl.bindVertexArray(this.lines);
    this.lineBuffer = attribute(gl, 0, new Float32Array(lines), 3, gl.FLOAT, false);
    for (let i = 0; i < 3; i++) {
      gl.enableVertexAttribArray(i);
      gl.vertexAttribDivisor(i, 1);
    }
  }

  // Tracks from the frame before to this one, where both points are known.
  addTracks(lines, frame) {
    const { tracks } = this.result;
    if (!tracks) return;
    const count = tracks.colors.length / 3;
    for (let i = 0; i < count; i++) {
      const [a, b] = [frame - 1, frame].map((f) => tracks.positions.subarray(3 * (f * count + i), 3 * (f * count + i) + 3));
      if (!isNaN(a[0]) && !isNaN(b[0])) lines.push(...a, ...b, ...Array.from(tracks.colors.subarray(3 * i, 3 * i + 3), (value) => value / 255));
    }
  }

  makePictures() {
    const { gl, result } = this;
    const { columns, rows } = result;
    const vertices = [];
    for (let frame = 0; frame < result.frames; frame++) {
      const [column, row] = [frame % columns, Math.floor(frame / columns)];
      [[0, 0], [1, 0], [1, 1], [0, 1]].forEach(([x, y], i) =>
        vertices.push(...result.corners.subarray(15 * frame + 3 * (i + 1), 15 * frame + 3 * (i + 2)), (column + x) / columns, (row + y) / rows));
    }
    this.pictures = gl.createVertexArray();
    gl.bindVertexArray(this.pictures);
    gl.bindBuffer(gl.ARRAY_BUFFER, gl.createBuffer());
    gl.bufferData(gl.ARRAY_BUFFER, new Float32Array(vertices), gl.STATIC_DRAW);
    [[0, 3, 0], [1, 2, 12]].forEach(([index, size, start]) => {
      gl.enableVertexAttribArray(index);
      gl.vertexAttribPointer(index, size, gl.FLOAT, false, 20, start);
    });
    this.sheet = gl.createTexture();
    gl.bindTexture(gl.TEXTURE_2D, this.sheet);
    gl.texImage2D(gl.TEXTURE_2D, 0, gl.RGBA, gl.RGBA, gl.UNSIGNED_BYTE, result.sheet);
    gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_MIN_FILTER, gl.LINEAR);
    gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_WRAP_S, gl.CLAMP_TO_EDGE);
    gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_WRAP_T, gl.CLAMP_TO_EDGE);
  }
}

function attribute(gl, index, values, size, type, isShare) {
  const buffer = gl.createBuffer();
  gl.bindBuffer(gl.ARRAY_BUFFER, buffer);
  gl.bufferData(gl.ARRAY_BUFFER, values, gl.STATIC_DRAW);
  gl.enableVertexAttribArray(index);
  gl.vertexAttribPointer(index, size, type, isShare, 0, 0);
  return buffer;
}

// Frames whose cameras stand so far apart that their frusta do not cover each other.
function spacedFrames({ frames, poses, frustumSize }) {
  const chosen = [0];
  for (let frame = 1; frame < frames; frame++)
    if (chosen.every((other) => Math.hypot(...subtract(poses[frame].eye, poses[other].eye)) > 1.4 * frustumSize)) chosen.push(frame);
  return chosen;
}
