// Reads the data, starts the viewer, and plays.

async function main() {
  const message = element("message");
  try {
    const viewer = new Viewer(element("scene"), await readData());
    const controls = new Controls(viewer);
    window.vggtjax = { viewer, controls };
    const isCalm = matchMedia("(prefers-reduced-motion: reduce)").matches;
    window.vggtjax.welcome = new Welcome(viewer, isCalm);
    if (!isCalm && viewer.result.frames > 1) controls.play(true);
  } catch (error) {
    message.textContent = error.message;
    message.hidden = false;
    throw error;
  }
}

// Loads the page anew when the server has another one, as of a result that grows.
async function watch(seconds) {
  let known = null;
  for (;;) {
    try {
      const tag = (await fetch(location.href, { method: "HEAD" })).headers.get("ETag");
      if (tag === null) return;
      if (known !== null && tag !== known) location.reload();
      known = tag;
    } catch {}  // the server has ended, or starts again
    await new Promise((resolve) => setTimeout(resolve, 1000 * seconds));
  }
}

main();
if (location.protocol.startsWith("http")) watch(3);
