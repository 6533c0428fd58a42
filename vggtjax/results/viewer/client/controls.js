// The settings, the time line, the keys, and the files that the page saves.

const element = (id) => document.getElementById(id);
const SLIDERS = { size: "size", "least-static": "leastStatic", "least-moving": "leastMoving", steps: "steps", trail: "trail" };
const SWITCHES = ["static", "moving", "cameras", "pictures", "path", "tracks", "loop"];
const SPEEDS = [0.1, 0.25, 0.5, 1, 2, 4];
const NARROW = 700; // pixels of a window that has no room for the settings beside the scene
const TURN = 8000; // milliseconds of the turntable video
const READING = 8000; // milliseconds that a message stays

class Controls {
  constructor(viewer) {
    this.viewer = viewer;
    this.listenToInputs();
    this.listenToButtons();
    this.listenToKeys();
    viewer.orbit.listen(viewer.canvas, () => this.leaveFlight());
    viewer.ondraw = () => this.refresh();
    this.offerResults();
    document.documentElement.classList.toggle("bare", window.innerWidth < NARROW);
    this.choose(0);
  }

  listenToInputs() {
    const { viewer } = this;
    element("steps").max = viewer.result.largestStep; // points beside larger ones are not in the page
    for (const [id, name] of Object.entries(SLIDERS)) {
      const input = element(id);
      input.value = viewer.settings[name];
      const label = () => {
        const { unit } = input.dataset;
        input.parentElement.querySelector("output").textContent = unit === "percent" ? `${Math.round(100 * input.value)} %` : input.value + unit;
      };
      input.addEventListener("input", () => { viewer.set({ [name]: Number(input.value) }); label(); });
      label();
    }
    for (const name of SWITCHES) {
      element(name).checked = viewer.settings[name];
      element(name).addEventListener("change", (event) => viewer.set({ [name]: event.target.checked }));
    }
    element("speed").append(...SPEEDS.map((speed) => new Option(`${speed}x`, speed, speed === 1, speed === 1)));
    element("speed").addEventListener("change", (event) => viewer.set({ speed: Number(event.target.value) }));
    element("color").addEventListener("change", (event) => this.color(Number(event.target.value)));
    element("time").addEventListener("input", (event) => { this.play(false); viewer.show(Number(event.target.value)); });
  }

  listenToButtons() {
    const actions = {
      play: () => this.play(), fly: () => this.fly(), screenshot: () => this.screenshot(), turntable: () => this.turntable(),
      reset: () => { this.leaveFlight(); this.viewer.orbit.reset(); },
      toggle: () => { document.documentElement.classList.toggle("bare"); this.viewer.wanted = true; },
    };
    for (const [id, action] of Object.entries(actions)) element(id).addEventListener("click", action);
  }

  listenToKeys() {
    const { viewer } = this;
    const step = (by) => { this.play(false); viewer.show((viewer.frame + by + viewer.result.frames) % viewer.result.frames); };
    const actions = {
      " ": () => this.play(), ArrowLeft: () => step(-1), ArrowRight: () => step(1), f: () => this.fly(), r: () => element("reset").click(),
      c: () => this.color((viewer.settings.color + 1) % viewer.result.colors.length), p: () => this.screenshot(), t: () => this.turntable(),
      v: () => this.sideBySide(), h: () => element("toggle").click(),
    };
    window.addEventListener("keydown", (event) => {
      if (event.ctrlKey || event.metaKey || event.altKey || ["INPUT", "SELECT", "BUTTON"].includes(event.target.tagName) && event.key.length > 1) return;
      if (event.target.tagName === "BUTTON" && event.key === " " || event.target.tagName === "SELECT") return;
      const action = actions[event.key] ?? (event.key >= "1" && event.key <= "9" && viewer.results[event.key - 1] && (() => this.choose(event.key - 1)));
      if (!action) return;
      event.preventDefault();
      action();
    });
  }

  offerResults() {
    const { results } = this.viewer;
    element("results").hidden = results.length < 2;
    const button = (text, action) => Object.assign(document.createElement("button"), { textContent: text, title: text, onclick: action });
    element("results").append(...results.map((result, i) => button(result.name, () => this.choose(i))), button("Side by side (V)", () => this.sideBySide()));
  }

  choose(index) {
    const { viewer } = this;
    const name = viewer.result.colors[viewer.settings.color].name;
    viewer.set({ active: index, side: false });
    this.describe();
    this.color(Math.max(0, viewer.result.colors.findIndex((color) => color.name === name)));
  }

  sideBySide() {
    const { viewer } = this;
    if (viewer.results.length < 2) return;
    viewer.set({ side: !viewer.settings.side });
    this.describe();
  }

  describe() {
    const { viewer } = this, { result, results, settings } = viewer;
    for (const name of ["name", "facts", "note"]) element(name).textContent = result[name];
    element("about").hidden = settings.side;
    element("columns").replaceChildren(...(settings.side ? viewer.shownModels : []).map((model) => this.column(model.result)));
    [...element("results").children].forEach((button, i) => button.setAttribute("aria-pressed", i === results.length ? settings.side : !settings.side && i === settings.active));
    element("time").max = result.frames - 1;
    element("tracks").parentElement.hidden = !results.some(({ tracks }) => tracks);
    element("color").replaceChildren(...result.colors.map(({ name }, i) => new Option(name, i)));
    const moving = result.positions.length / 3 - result.staticCount;
    element("counts").textContent = `${result.staticCount.toLocaleString("en")} static and ${moving.toLocaleString("en")} moving points`;
  }

  // What stands above a result side by side.
  column({ name, facts, note }) {
    const column = document.createElement("div");
    const line = (kind, text) => Object.assign(document.createElement(kind), { textContent: text });
    column.append(line("h2", name), line("p", facts), line("p", note));
    return column;
  }

  color(index) {
    this.viewer.set({ color: index });
    element("color").value = index;
    const { ramp, low, high, names } = this.viewer.result.colors[index];
    element("legend").hidden = !ramp;
    if (!ramp) return;
    element("ramp").hidden = Boolean(names);
    [element("low").textContent, element("high").textContent] = [low ?? "", high ?? ""];
    const rgb = (value) => ramp.subarray(3 * value, 3 * value + 3);
    const pixels = new ImageData(256, 1);
    for (let i = 0; i < 256; i++) pixels.data.set([...rgb(i), 255], 4 * i);
    element("ramp").getContext("2d").putImageData(pixels, 0, 0);
    element("names").replaceChildren(...(names ?? []).map(([value, text]) => {
      const row = document.createElement("li"), swatch = document.createElement("span");
      swatch.style.background = `rgb(${rgb(value)})`;
      row.append(swatch, text);
      return row;
    }));
  }

  play(playing = !this.viewer.playing) {
    const { viewer } = this;
    if (playing && viewer.frame === viewer.result.frames - 1) viewer.time = 0;
    viewer.playing = playing;
    viewer.wanted = true;
  }

  fly(flying = !this.viewer.settings.fly) {
    this.viewer.set({ fly: flying });
    element("fly").setAttribute("aria-pressed", flying);
  }

  // From flight, the view stays where it is and can be turned.
  leaveFlight() {
    const { viewer } = this;
    if (!viewer.settings.fly) return;
    const { pose } = clipCamera(viewer.result, viewer.time);
    viewer.orbit.look(pose.eye, add(pose.eye, scaled(pose.forward, viewer.result.scale)));
    this.fly(false);
  }

  refresh() {
    const { viewer } = this, { result, frame } = viewer;
    element("play").textContent = viewer.playing ? "❚❚" : "▶";
    element("time").value = frame;
    const seconds = result.times ? `${result.times[frame].toFixed(2)} s` : "";
    element("moment").textContent = `frame ${frame} of ${result.frames - 1}  ${seconds}`;
    this.drawPicture();
  }

  // The picture of this frame, in the corner.
  drawPicture() {
    const { viewer } = this, { result, frame } = viewer;
    const canvas = element("picture");
    canvas.hidden = !viewer.settings.pictures || !result.hasPictures;
    const [width, height] = result.tile;
    if (canvas.width !== width || canvas.height !== height) Object.assign(canvas, { width, height });
    canvas.style.width = `${Math.min(200, (130 * width) / height)}px`;
    canvas.getContext("2d").drawImage(result.sheet, (frame % result.columns) * width, Math.floor(frame / result.columns) * height, width, height, 0, 0, width, height);
  }

  say(sentence) {
    element("message").textContent = sentence;
    element("message").hidden = false;
    clearTimeout(this.silence);
    this.silence = setTimeout(() => { element("message").hidden = true; }, READING);
  }

  save(blob, ending) {
    const stem = this.viewer.result.name.replace(/[^\w.-]+/g, "_").slice(0, 60) || "result";
    const link = Object.assign(document.createElement("a"), { href: URL.createObjectURL(blob), download: `${stem}_${ending}` });
    link.click();
    setTimeout(() => URL.revokeObjectURL(link.href), 60000);
  }

  screenshot() {
    this.viewer.compose(this.viewer.views()); // the canvas keeps its pixels until the end of this call
    this.viewer.canvas.toBlob((blob) => this.save(blob, `frame_${String(this.viewer.frame).padStart(4, "0")}.png`));
  }

  turntable() {
    const { viewer } = this;
    if (this.recorder) return;
    const type = ["video/webm;codecs=vp9", "video/webm", "video/mp4"].find((name) => window.MediaRecorder?.isTypeSupported(name));
    if (!type) {
      this.say("This browser records no video. Open the page in another browser, or make a film with vggtjax render.");
      return;
    }
    this.leaveFlight();
    const recorder = (this.recorder = new MediaRecorder(viewer.canvas.captureStream(30), { mimeType: type, videoBitsPerSecond: 12e6 }));
    const pieces = [], yaw = viewer.orbit.yaw, started = performance.now();
    recorder.ondataavailable = ({ data }) => pieces.push(data);
    recorder.onstop = () => {
      this.recorder = viewer.ontick = null;
      viewer.orbit.yaw = yaw;
      element("turntable").setAttribute("aria-pressed", false);
      this.save(new Blob(pieces, { type }), `turntable.${type.startsWith("video/mp4") ? "mp4" : "webm"}`);
    };
    viewer.ontick = (now) => {
      viewer.orbit.yaw = yaw + (2 * Math.PI * Math.min(now - started, TURN)) / TURN;
      if (now - started >= TURN && recorder.state === "recording") recorder.stop();
    };
    element("turntable").setAttribute("aria-pressed", true);
    recorder.start();
  }
}
