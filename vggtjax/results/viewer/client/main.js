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

// Loads the page anew when its server shows another one, as of a result that has grown; exported pages have no tag.
async function watch(tag, seconds) {
  for (;;) {
    await new Promise((resolve) => setTimeout(resolve, 1000 * seconds));
    try {
      const answer = await fetch(location.href, { method: "HEAD" });
      if (answer.ok && answer.headers.get("ETag") !== `"${tag}"`) location.reload();
    } catch {}  // the server has ended; it may start again
  }
}

main();
const page = document.querySelector('meta[name="page"]').content;
if (page) watch(page, 3);
