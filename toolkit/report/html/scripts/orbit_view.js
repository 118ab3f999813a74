/** Trajectories and landmarks in three dimensions, seen by an eye that goes around them. */
function orbitView(scene) {
  const START = { azimuth: -0.9, elevation: 0.62, zoom: 1, x: 0, y: 0 };
  const view = { ...START };
  const centre = scene.box.map(([low, high]) => (low + high) / 2);
  const radius = Math.max(Math.hypot(...scene.box.map(([low, high]) => high - low)) / 2, 1e-3);
  const DISTANCE = 3.2; // of the eye from the centre, in radii
  let size = [1, 1];
  let turn = null; // sines and cosines, once a drawing

  function aim() {
    turn = [Math.sin(view.azimuth), Math.cos(view.azimuth), Math.sin(view.elevation), Math.cos(view.elevation)];
  }

  /** Turn a point so that x is to the right, y up and the eye looks along -z; project it in perspective. */
  function at(x, y, z) {
    const [sa, ca, se, ce] = turn;
    const [dx, dy, dz] = [(x - centre[0]) / radius, (y - centre[1]) / radius, (z - centre[2]) / radius];
    const right = -sa * dx + ca * dy;
    const ahead = ca * dx + sa * dy;
    const up = ce * dz - se * ahead;
    const depth = DISTANCE - (se * dz + ce * ahead);
    if (depth < 0.2) return null;
    const k = (Math.min(size[0], size[1] * 1.5) * 0.5 * view.zoom * (DISTANCE - 0.4)) / depth;
    return [size[0] / 2 + view.x + right * k, size[1] / 2 + view.y - up * k];
  }

  function draw(context, width, height) {
    size = [width, height];
    aim();
    drawFloor(context);
    drawScene(context, scene, at);
    drawAxes(context, height);
  }

  /** A grid under everything, in squares of a round number of metres. */
  function drawFloor(context) {
    const [[x0, x1], [y0, y1], [z0]] = scene.box;
    const step = roundLength(Math.max(x1 - x0, y1 - y0, 1e-3) / 5);
    const [left, right] = [Math.floor(x0 / step) * step, Math.ceil(x1 / step) * step];
    const [low, high] = [Math.floor(y0 / step) * step, Math.ceil(y1 / step) * step];
    context.strokeStyle = ink("--grid");
    context.lineWidth = 1;
    context.setLineDash([]);
    for (let x = left; x <= right + step / 2; x += step) strokeLine(context, 2, (i) => at(x, i ? high : low, z0));
    for (let y = low; y <= high + step / 2; y += step) strokeLine(context, 2, (i) => at(i ? right : left, y, z0));
    context.fillStyle = ink("--faint");
    context.textAlign = "right";
    context.fillText(`squares of ${shortText(step)} m`, size[0] - 8, size[1] - 8);
    context.textAlign = "left";
  }

  /** Which way x, y and z point. */
  function drawAxes(context, height) {
    const [sa, ca, se, ce] = turn;
    const ways = { x: [-sa, -se * ca], y: [ca, -se * sa], z: [0, ce] };
    const [x, y] = [38, height - 38];
    context.lineWidth = 2;
    context.setLineDash([]);
    context.strokeStyle = ink("--faint");
    context.fillStyle = ink("--text");
    context.textAlign = "center";
    for (const [name, [right, up]] of Object.entries(ways)) {
      strokeLine(context, 2, (i) => [x + i * right * 22, y - i * up * 22]);
      context.fillText(name, x + right * 31, y - up * 31 + 4);
    }
    context.textAlign = "left";
  }

  function rotate(dx, dy) {
    view.azimuth -= dx * 0.008;
    view.elevation = Math.min(Math.max(view.elevation + dy * 0.008, -Math.PI / 2), Math.PI / 2);
    changed();
  }

  function move(dx, dy) {
    view.x += dx;
    view.y += dy;
    changed();
  }

  function zoom(factor, x = size[0] / 2, y = size[1] / 2) {
    const after = Math.min(Math.max(view.zoom * factor, 0.1), 100);
    const grown = after / view.zoom;
    view.x = x - size[0] / 2 - (x - size[0] / 2 - view.x) * grown;
    view.y = y - size[1] / 2 - (y - size[1] / 2 - view.y) * grown;
    view.zoom = after;
    changed();
  }

  function reset() {
    Object.assign(view, START);
    changed();
  }

  const label = `${scene.case.title} in three dimensions: ${scene.tracks.length} trajectories. ` +
    "Arrow keys turn the view, with Shift they move it, plus and minus zoom, 0 shows all.";
  const canvas = sharpCanvas({ class: "view", tabindex: "0", role: "img", "aria-label": label, "data-view": "orbit" }, draw);
  const key = (dx, dy) => (event) => (event.shiftKey ? move(-dx, -dy) : rotate(dx, dy));
  addGestures(canvas, {
    drag: (dx, dy, event, pinching) => (event.shiftKey || event.buttons === 4 || pinching ? move(dx, dy) : rotate(dx, dy)),
    zoom,
    hover: (x, y, event) => hoverScene(scene, at, x, y, event),
    leave: hideHint,
    keys: {
      ArrowLeft: key(-24, 0), ArrowRight: key(24, 0), ArrowUp: key(0, -24), ArrowDown: key(0, 24),
      "+": () => zoom(1.25), "=": () => zoom(1.25), "-": () => zoom(0.8), 0: reset,
    },
  });
  const buttons = viewButtons([
    ["+", "Zoom in", () => zoom(1.4)],
    ["−", "Zoom out", () => zoom(1 / 1.4)],
    ["↻", "Turn", () => rotate(60, 0)],
    ["↥", "Look from higher up", () => rotate(0, 30)],
    ["⤢", "Show all", reset],
  ]);
  return viewCard("In three dimensions", scene, canvas, buttons, "Drag to turn, with Shift to move; two fingers, or Ctrl and wheel, to zoom.");
}
