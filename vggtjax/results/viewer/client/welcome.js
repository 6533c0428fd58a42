// The first view: it swings slowly, twice, and what moves has a halo, until the first touch.

const SWING = 0.14; // radians to either side
const PERIOD = 14000; // milliseconds of a swing there and back
const TOUCHES = ["pointerdown", "wheel", "keydown", "click", "input"];

class Welcome {
  // isCalm: nothing moves by itself; the halo is there all the same.
  constructor(viewer, isCalm) {
    Object.assign(this, { viewer, isCalm });
    this.leave = () => this.end();
    for (const name of TOUCHES) window.addEventListener(name, this.leave, { capture: true, passive: true });
    viewer.halo = 1;
    if (!isCalm) viewer.ontick = (now) => this.swing(now);
  }

  swing(now) {
    const { viewer } = this;
    this.started ??= now;
    const passed = now - this.started;
    viewer.orbit.swing(SWING * Math.sin((2 * Math.PI * passed) / PERIOD));
    viewer.wanted = true;
    if (viewer.sharpness < 1 || passed > 2 * PERIOD) this.rest(); // a machine that draws slowly, or back where it began
  }

  rest() {
    Object.assign(this.viewer, { ontick: null, sharpness: 1, slow: 0, wanted: true });
  }

  end() {
    for (const name of TOUCHES) window.removeEventListener(name, this.leave, { capture: true });
    this.rest();
    if (this.isCalm) this.viewer.halo = 0;
    this.viewer.fades = true;
  }
}
