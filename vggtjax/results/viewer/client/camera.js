// The viewer's camera: it turns about a target, or follows the camera of the clip.

const [NARROWEST, WIDEST] = [0.02, 2]; // tangents of half a field of view
const STEEPEST = 1.5; // radians

class Orbit {
  // home: {eye, target, up} in the world, and the tangents of half the fields of view that fill the canvas.
  constructor(home) {
    [this.wide, this.tall] = home.tangents.map((tangent) => Math.min(Math.max(tangent, NARROWEST), WIDEST));
    this.home = home;
    this.up = normalised(home.up);
    const ahead = subtract(home.target, home.eye);
    const level = subtract(ahead, scaled(this.up, dot(ahead, this.up)));
    this.ahead = normalised(Math.hypot(...level) > 1e-9 ? level : cross(this.up, [this.up[1], this.up[2], this.up[0]]));
    this.side = cross(this.ahead, this.up);
    this.reset();
  }

  reset() {
    this.look(this.home.eye, this.home.target);
  }

  look(eye, target) {
    const ahead = subtract(target, eye);
    const forward = normalised(ahead);
    this.target = target;
    this.distance = Math.hypot(...ahead);
    this.yaw = Math.atan2(dot(forward, this.side), dot(forward, this.ahead));
    this.pitch = Math.asin(Math.min(Math.max(-dot(forward, this.up), -1), 1));
  }

  // Tangent of half the vertical field of view, on a canvas of this shape.
  tallOn(aspect) {
    return Math.max(this.tall, this.wide / aspect);
  }

  pose() {
    const [c, s] = [Math.cos(this.yaw), Math.sin(this.yaw)];
    const level = add(scaled(this.ahead, c), scaled(this.side, s));
    const forward = add(scaled(level, Math.cos(this.pitch)), scaled(this.up, -Math.sin(this.pitch)));
    const right = subtract(scaled(this.side, c), scaled(this.ahead, s));
    return poseFrom(subtract(this.target, scaled(forward, this.distance)), forward, right);
  }

  turn(x, y) {
    this.yaw += 0.005 * x;
    this.pitch = Math.min(Math.max(this.pitch + 0.005 * y, -STEEPEST), STEEPEST);
  }

  // By pixels of a canvas.
  move(x, y, { clientWidth, clientHeight }) {
    const { right, down } = this.pose();
    const step = (2 * this.tallOn(clientWidth / clientHeight) * this.distance) / clientHeight;
    this.target = subtract(this.target, add(scaled(right, x * step), scaled(down, y * step)));
  }

  // The yaw of the first view plus this, in radians.
  swing(angle) {
    this.look(this.home.eye, this.home.target);
    this.yaw += angle;
  }

  zoom(factor) {
    this.distance = Math.min(Math.max(this.distance * factor, 1e-6), 1e9);
  }

  // Mouse, touch and wheel; `touched` is called before every change.
  listen(canvas, touched) {
    const pointers = new Map();
    canvas.addEventListener("pointerdown", (event) => {
      canvas.setPointerCapture(event.pointerId);
      pointers.set(event.pointerId, [event.clientX, event.clientY]);
    });
    for (const name of ["pointerup", "pointercancel"]) canvas.addEventListener(name, (event) => pointers.delete(event.pointerId));
    canvas.addEventListener("pointermove", (event) => {
      const last = pointers.get(event.pointerId);
      if (!last) return;
      touched();
      const now = [event.clientX, event.clientY];
      const [x, y] = [now[0] - last[0], now[1] - last[1]];
      const other = [...pointers].find(([id]) => id !== event.pointerId);
      if (other) {
        const spread = (place) => Math.hypot(place[0] - other[1][0], place[1] - other[1][1]);
        this.zoom(spread(last) / Math.max(spread(now), 1));
        this.move(x / 2, y / 2, canvas);
      } else if (event.buttons & 6 || event.shiftKey) this.move(x, y, canvas);
      else this.turn(x, y);
      pointers.set(event.pointerId, now);
    });
    canvas.addEventListener("wheel", (event) => {
      event.preventDefault();
      touched();
      this.zoom(Math.exp(0.0012 * event.deltaY * (event.deltaMode ? 30 : 1)));
    }, { passive: false });
    canvas.addEventListener("contextmenu", (event) => event.preventDefault());
  }
}

// The clip's own camera at a time in frames, and the tangent of half its vertical field of view.
function clipCamera(result, time) {
  const frame = Math.min(Math.floor(time), result.frames - 1);
  const next = Math.min(frame + 1, result.frames - 1);
  const [wide, tall] = result.tangents.subarray(2 * frame, 2 * frame + 2);
  return { pose: poseBetween(result.poses[frame], result.poses[next], time - frame), wide, tall };
}
