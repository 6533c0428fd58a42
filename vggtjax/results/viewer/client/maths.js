// Vectors are arrays of three; matrices hold 16 numbers, column by column, as WebGL takes them.
// A pose is {eye, right, down, forward}: OpenCV's axes of a camera, in the world.

const add = (a, b) => [a[0] + b[0], a[1] + b[1], a[2] + b[2]];
const subtract = (a, b) => [a[0] - b[0], a[1] - b[1], a[2] - b[2]];
const scaled = (a, s) => [a[0] * s, a[1] * s, a[2] * s];
const dot = (a, b) => a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
const cross = (a, b) => [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]];
const normalised = (a) => scaled(a, 1 / Math.max(Math.hypot(...a), 1e-12));
const mixed = (a, b, t) => add(scaled(a, 1 - t), scaled(b, t));

function multiply(a, b) {
  const product = new Float32Array(16);
  for (let column = 0; column < 4; column++)
    for (let row = 0; row < 4; row++)
      for (let k = 0; k < 4; k++) product[4 * column + row] += a[4 * k + row] * b[4 * column + k];
  return product;
}

// The world seen from a pose, in WebGL's axes (y up, z backward).
function viewMatrix({ eye, right, down, forward }) {
  const [x, y, z] = [right, scaled(down, -1), scaled(forward, -1)];
  return new Float32Array([
    x[0], y[0], z[0], 0, x[1], y[1], z[1], 0, x[2], y[2], z[2], 0, -dot(x, eye), -dot(y, eye), -dot(z, eye), 1,
  ]);
}

// tall: tangent of half the vertical field of view.
function projectionMatrix(tall, aspect, near, far) {
  const depth = 1 / (near - far);
  return new Float32Array([1 / (tall * aspect), 0, 0, 0, 0, 1 / tall, 0, 0, 0, 0, (near + far) * depth, -1, 0, 0, 2 * near * far * depth, 0]);
}

// A pose whose forward axis is exact, and whose right axis is as given where possible.
function poseFrom(eye, forward, right) {
  forward = normalised(forward);
  const down = normalised(cross(forward, right));
  return { eye, right: cross(down, forward), down, forward };
}

// Between two poses that lie near each other.
function poseBetween(a, b, t) {
  return poseFrom(mixed(a.eye, b.eye, t), mixed(a.forward, b.forward, t), mixed(a.right, b.right, t));
}
