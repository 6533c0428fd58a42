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

main();
