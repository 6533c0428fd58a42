// From the data of the page to typed arrays.

const TYPES = { uint8: Uint8Array, uint16: Uint16Array, uint32: Uint32Array, float32: Float32Array };

async function inflated(base64) {
  const letters = atob(base64);
  const packed = new Uint8Array(letters.length);
  for (let i = 0; i < letters.length; i++) packed[i] = letters.charCodeAt(i);
  const stream = new Blob([packed]).stream().pipeThrough(new DecompressionStream("deflate"));
  return new Response(stream).arrayBuffer();
}

// Replaces every {type, start, length} of the tree by its array.
function withArrays(tree, buffer) {
  if (tree === null || typeof tree !== "object") return tree;
  if (tree.type in TYPES && "start" in tree) return new TYPES[tree.type](buffer, tree.start, tree.length);
  for (const key of Object.keys(tree)) tree[key] = withArrays(tree[key], buffer);
  return tree;
}

// Positions are stored as d / (scale + |d|) of the offset d from the centre, in 16 bits from -1 to 1: fine near the
// centre, coarse far away.
function positionsOf(stored, centre, scale) {
  const positions = new Float32Array(stored.length);
  for (let i = 0; i < stored.length; i += 3) {
    const x = stored[i] / 32767.5 - 1, y = stored[i + 1] / 32767.5 - 1, z = stored[i + 2] / 32767.5 - 1;
    const factor = scale / Math.max(1 - Math.hypot(x, y, z), 1e-5);
    positions[i] = centre[0] + factor * x;
    positions[i + 1] = centre[1] + factor * y;
    positions[i + 2] = centre[2] + factor * z;
  }
  return positions;
}

async function pictureOf(url) {
  const image = new Image();
  image.src = url;
  await image.decode();
  return createImageBitmap(image);
}

async function readData() {
  const element = document.getElementById("data");
  const { results, arrays } = JSON.parse(element.textContent);
  element.remove();
  const buffer = await inflated(arrays);
  return Promise.all(
    withArrays(results, buffer).map(async (result) => ({
      ...result,
      positions: positionsOf(result.positions, result.centre, result.scale),
      sheet: await pictureOf(result.sheet),
      poses: Array.from({ length: result.frames }, (_, frame) => poseOf(result.poses.subarray(12 * frame, 12 * frame + 12))),
    })),
  );
}

// Rows of world-from-camera, 3 x 4.
const poseOf = (m) => ({ right: [m[0], m[4], m[8]], down: [m[1], m[5], m[9]], forward: [m[2], m[6], m[10]], eye: [m[3], m[7], m[11]] });
