// The first seconds: the view swings slowly, twice, and what moves glows, until the first touch.

const SWING = 0.14; // radians to either side
const PERIOD = 14000; // milliseconds of a swing there and back
const GLOWING = 7000, BEAT = 1400; // milliseconds that moving points glow, and of one beat
const BRIGHTEST = 0.8; // share of the glow's colour
const TOUCHES = ["pointerdown", "wheel", "keydown", "click", "input"];

class Welcome {
  constructor(viewer) {
    this.viewer = viewer;
    this.leave = () => this.end();
    for (const name of TOUCHES) window.addEventListener(name, this.leave, { capture: true, passive: true });
    viewer.ontick = (now) => this.show(now);
  }

  show(now) {
    const { viewer } = this;
    this.started ??= now;
    const passed = now - this.started;
    viewer.orbit.swing(SWING * Math.sin((2 * Math.PI * passed) / PERIOD));
    viewer.glow = BRIGHTEST * Math.max(1 - passed / GLOWING, 0) * Math.sin((Math.PI * passed) / BEAT) ** 2;
    viewer.wanted = true;
    if (viewer.sharpness < 1 || passed > 2 * PERIOD) this.end(); // a machine that draws slowly, or back where it began
  }

  end() {
    const { viewer } = this;
    for (const name of TOUCHES) window.removeEventListener(name, this.leave, { capture: true });
    Object.assign(viewer, { ontick: null, glow: 0, sharpness: 1, slow: 0, wanted: true });
  }
}
