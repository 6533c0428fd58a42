// What is shown, and when it is drawn again.

const BACKGROUND = [38 / 255, 38 / 255, 46 / 255];
// Around what moves until the first touch: a dark rim around a bright one, which some surface may be like, never both.
const RIMS = [{ rim: 4.5, color: [0.02, 0.05, 0.1] }, { rim: 3, color: [0.25, 1, 0.95] }]; // halves of CSS pixels
const TINT = 0.25; // share of the bright rim's colour that the moving points take on
const FADING = 900; // milliseconds in which the halo fades
const FAINT = 0.5; // how much of the background's colour the cameras of other moments take on
const SLOW = 42, FAST = 24; // milliseconds of a picture, above and below which fewer and more points are drawn
const STILL = 160; // milliseconds without a change of the view, after which all points are drawn
const FEWEST = 6000; // points of the background while the view moves
const PATIENCE = 6; // slow pictures in a row, after which fewer pixels are drawn while something moves
const COARSEST = 0.5; // share of the canvas' pixels along a side
const MOST_VIEWS = 4; // side by side

class Viewer {
  constructor(canvas, results) {
    const gl = canvas.getContext("webgl2", { antialias: false, alpha: false });
    if (!gl) throw new Error("This browser shows no 3-D graphics: WebGL 2 is off or missing. Open the file in another browser.");
    Object.assign(this, { canvas, gl, results });
    this.painter = new Painter(gl);
    this.models = results.map((result) => new Model(gl, result));
    this.targets = new Targets(gl);
    this.orbit = new Orbit(results[0].home);
    this.settings = {
      color: 0, size: 1, leastStatic: 20, leastMoving: 20, steps: 0.08, trail: 0, static: true, moving: true,
      cameras: true, pictures: true, path: true, tracks: true, fly: false, active: 0, side: false, loop: true, speed: 1,
    };
    this.halo = 0; // around what moves, from 0 to 1
    this.fades = false; // the halo, to 0
    this.time = 0; // in frames
    this.playing = false;
    this.budget = 60000; // points of the background while the view moves
    this.sharpness = 1; // pixels drawn along a side while something moves, as a share of the canvas'
    this.slow = 0; // slow pictures in a row
    this.drawn = 0; // pictures so far
    this.wanted = true;
    this.last = performance.now();
    this.settledAt = null; // when the view last changed; null: all points are drawn
    requestAnimationFrame((now) => this.tick(now));
  }

  get result() { return this.results[this.settings.active]; }
  get frame() { return Math.min(Math.floor(this.time), this.result.frames - 1); }
  // Side by side, as many as fit, among them the active one.
  get shownModels() {
    const { active, side } = this.settings;
    const first = side ? Math.min(active, Math.max(this.models.length - MOST_VIEWS, 0)) : active;
    return this.models.slice(first, first + (side ? MOST_VIEWS : 1));
  }

  set(changes) {
    Object.assign(this.settings, changes);
    if ("color" in changes) this.paint();
    this.time = Math.min(this.time, this.result.frames - 1e-6);
    this.wanted = true;
  }

  // Colours go by name, as results may offer different ones.
  paint() {
    const { name } = this.result.colors[this.settings.color];
    this.models.forEach((model) => model.paint(model.result.colors.find((color) => color.name === name) ?? model.result.colors[0]));
    this.viewKey = null;
  }

  show(frame) {
    this.time = Math.min(Math.max(frame, 0), this.result.frames - 1);
    this.wanted = true;
  }

  advance(milliseconds) {
    if (!this.playing) return;
    const before = this.frame;
    const { frames, rate } = this.result;
    this.time += (milliseconds / 1000) * rate * this.settings.speed;
    if (this.time >= frames) {
      this.time = this.settings.loop ? this.time % frames : frames - 1;
      this.playing = this.settings.loop;
    }
    if (this.frame !== before || this.settings.fly) this.wanted = true;
  }

  // Where each result is drawn, and from where it is seen.
  views() {
    const { width, height } = this.canvas;
    const models = this.shownModels;
    return models.map((model, i) => {
      const left = Math.round((width * i) / models.length);
      const span = Math.round((width * (i + 1)) / models.length) - left;
      const aspect = span / height;
      let [pose, tall] = [this.orbit.pose(), this.orbit.tallOn(aspect)];
      if (this.settings.fly) {
        const camera = clipCamera(model.result, Math.min(this.time, model.result.frames - 1));
        [pose, tall] = [camera.pose, Math.max(camera.tall, camera.wide / aspect)];
      }
      const near = 0.004 * model.result.scale;
      const matrix = multiply(projectionMatrix(tall, aspect, near, 2e6 * near), viewMatrix(pose));
      return { model, left, width: span, height, tall, near, matrix };
    });
  }

  tick(now) {
    requestAnimationFrame((next) => this.tick(next));
    const passed = Math.max(now - this.last, 0);
    this.last = now;
    this.advance(Math.min(passed, 1000));
    this.ontick?.(now, passed);
    if (this.fades) this.fade(passed);
    const isTurning = this.settledAt !== null && now - this.settledAt < STILL;
    if (isTurning || this.playing) this.adapt(passed, isTurning);
    this.fitCanvas(isTurning || this.playing ? this.sharpness : 1);
    const views = this.views();
    const key = this.keyOf(views);
    if (key !== this.viewKey) {
      this.viewKey = key;
      this.settledAt = now;
      this.drawBackground(views, this.targets.shown, true);
      this.refined = null;
      this.wanted = true;
    } else if (this.settledAt !== null && now - this.settledAt > STILL) this.refine(views);
    if (this.wanted) this.compose(views);
  }

  fade(milliseconds) {
    this.halo = Math.max(this.halo - milliseconds / FADING, 0);
    this.fades = this.halo > 0;
    this.wanted = true;
  }

  keyOf(views) {
    const { size, leastStatic, steps, fly } = this.settings;
    const shown = ["static", "cameras", "path"].map((name) => this.settings[name]);
    return JSON.stringify([size, leastStatic, steps, fly, shown, views.map(({ model, left, width, height, matrix }) => [this.models.indexOf(model), left, width, height, ...matrix])]);
  }

  // Draws less where pictures take long: fewer points while the view turns, then fewer pixels.
  adapt(passed, isTurning) {
    this.slow = passed > SLOW ? this.slow + 1 : 0;
    if (isTurning && passed > SLOW) this.budget = Math.max(FEWEST, this.budget * 0.85);
    if (isTurning && passed < FAST) this.budget = Math.min(4e6, this.budget * 1.2);
    if (this.slow < PATIENCE) return;
    this.sharpness = Math.max(COARSEST, this.sharpness - 0.25);
    this.slow = 0;
  }

  fitCanvas(sharpness) {
    const ratio = Math.min(window.devicePixelRatio || 1, 2) * sharpness;
    const [width, height] = [this.canvas.clientWidth, this.canvas.clientHeight].map((side) => Math.max(1, Math.round(side * ratio)));
    if (!this.targets.resize(width, height)) return;
    [this.canvas.width, this.canvas.height] = [width, height];
    this.viewKey = null;
  }

  into({ left, width, height }) {
    const { gl } = this;
    gl.viewport(left, 0, width, height);
    gl.scissor(left, 0, width, height);
    gl.enable(gl.SCISSOR_TEST);
  }

  // Cameras as thin lines, and the first points, which are spread over the scene; fewer points are drawn larger.
  drawBackground(views, target, isCoarse) {
    this.painter.hideBehind(null);
    this.targets.begin(target);
    const most = Math.floor(this.budget / views.length);
    for (const view of views) {
      this.into(view);
      const count = isCoarse ? Math.min(view.model.result.staticCount, most) : 0;
      const growth = Math.min(Math.sqrt(view.model.result.staticCount / Math.max(count, 1)), 3);
      this.drawStatic(view, 0, count, isCoarse ? growth : 1);
      if (!this.settings.fly) this.drawCameras(view);
    }
  }

  drawStatic(view, first, count, growth) {
    const { result } = view.model;
    const { size, leastStatic, steps } = this.settings;
    const options = { limits: [leastStatic / 100, steps / result.largestStep], size: size * growth };
    if (this.settings.static) this.painter.drawPoints(view.model, first, count, view, options);
  }

  drawCameras(view) {
    const { model } = view;
    const { cameras, path } = this.settings;
    if (path) this.painter.drawLines(model, model.path, view, 1.5);
    for (const frame of cameras ? model.frusta : []) this.painter.drawLines(model, model.frustumLines[frame], view, 1, [...BACKGROUND, FAINT]);
  }

  // Draws the background whole, some of it in every call, and shows it when it is done.
  refine(views) {
    if (this.refined === null) {
      this.drawBackground(views, this.targets.next, false);
      this.refined = 0;
    }
    this.painter.hideBehind(null);
    this.gl.bindFramebuffer(this.gl.FRAMEBUFFER, this.targets.next.buffer);
    const step = Math.ceil(this.budget / (this.playing ? 4 : 1) / views.length);
    for (const view of views) {
      this.into(view);
      this.drawStatic(view, this.refined, Math.min(step, view.model.result.staticCount - this.refined), 1);
    }
    this.refined += step;
    if (views.every(({ model }) => this.refined >= model.result.staticCount)) {
      [this.targets.shown, this.targets.next] = [this.targets.next, this.targets.shown];
      this.settledAt = null;
      this.wanted = true;
    }
  }

  compose(views) {
    this.wanted = false;
    this.targets.beginFrame();
    this.painter.hideBehind(this.targets.shown.depths);
    for (const view of views) {
      this.into(view);
      this.drawMoment(view);
    }
    this.drawn++;
    this.ondraw?.();
  }

  drawMoment(view) {
    const { model } = view, { result } = model;
    const { size, leastMoving, steps, trail, moving, cameras, pictures, tracks, fly } = this.settings;
    const frame = Math.min(this.frame, result.frames - 1);
    for (let past = Math.min(trail, frame); moving && past >= 0; past--) {
      const [first, end] = result.offsets.subarray(frame - past, frame - past + 2);
      const options = { limits: [leastMoving / 100, steps / result.largestStep], size };
      const blend = past ? [...BACKGROUND, 0.25 + (0.6 * past) / (trail + 1)] : [...RIMS[1].color, TINT * this.halo];
      const ratio = Math.min(window.devicePixelRatio || 1, 2) * this.halo;
      for (const { rim, color } of past || !this.halo ? [] : RIMS)
        this.painter.drawPoints(model, first, end - first, view, { ...options, rim: 2 * rim * ratio, blend: [...color, 1] });
      this.painter.drawPoints(model, first, end - first, view, { ...options, blend });
    }
    for (let past = 0; tracks && result.tracks && past < Math.max(trail, 8) && past < frame; past++)
      this.painter.drawLines(model, model.trackLines[frame - past], view, 1.6);
    if (!fly && cameras) {
      this.painter.drawLines(model, model.frustumLines[frame], view, 2.5);
      if (pictures) this.painter.drawPicture(model, frame, view);
    }
  }
}
