/** The world from above in equal scale, to be dragged and zoomed. */
function topView(scene) {
  const view = { x: 0, y: 0, zoom: 1 }; // the centre in metres from the box's, and how much larger than fitted
  const [[left, right], [low, high]] = scene.box;
  let size = [1, 1];

  function scale() {
    const margin = 28;
    const fitX = (size[0] - 2 * margin) / Math.max(right - left, 1e-3);
    const fitY = (size[1] - 2 * margin) / Math.max(high - low, 1e-3);
    return Math.max(Math.min(fitX, fitY), 1e-9) * view.zoom;
  }

  function at(x, y) {
    const k = scale();
    return [
      size[0] / 2 + (x - (left + right) / 2 - view.x) * k,
      size[1] / 2 - (y - (low + high) / 2 - view.y) * k,
    ];
  }

  function draw(context, width, height) {
    size = [width, height];
    drawGrid(context, width, height);
    drawScene(context, scene, at);
    drawScaleBar(context, height);
  }

  function drawGrid(context, width, height) {
    const k = scale();
    const step = roundLength(110 / k);
    const origin = at(0, 0);
    context.lineWidth = 1;
    context.setLineDash([]);
    context.strokeStyle = ink("--grid");
    context.fillStyle = ink("--faint");
    const first = (from, spacing) => ((from % spacing) + spacing) % spacing;
    context.textAlign = "center";
    for (let x = first(origin[0], step * k); x < width; x += step * k) {
      strokeLine(context, 2, (i) => [x, i * height]);
      const text = shortText(Math.round((x - origin[0]) / k / step) * step);
      // One that the edge would cut could lose its sign.
      const reach = context.measureText(text).width / 2;
      if (x >= reach && x <= width - reach) context.fillText(text, x, height - 6);
    }
    context.textAlign = "left";
    for (let y = first(origin[1], step * k); y < height - 20; y += step * k) {
      strokeLine(context, 2, (i) => [i * width, y]);
      if (y > 32) context.fillText(shortText(Math.round((origin[1] - y) / k / step) * step), 6, y - 4);
    }
    context.textAlign = "right";
    context.fillText("x [m]", width - 6, height - 20);
    context.textAlign = "left";
    context.fillText("y [m]", 6, 14);
  }

  function drawScaleBar(context, height) {
    const length = roundLength(120 / scale());
    const [x, y] = [44, height - 30];
    context.strokeStyle = ink("--text");
    context.fillStyle = ink("--text");
    context.lineWidth = 2;
    context.setLineDash([]);
    strokeLine(context, 4, (i) => [[x, y - 4], [x, y], [x + length * scale(), y], [x + length * scale(), y - 4]][i]);
    context.fillText(`${shortText(length)} m`, x + 6, y - 6);
  }

  function pan(dx, dy) {
    view.x -= dx / scale();
    view.y += dy / scale();
    changed();
  }

  function zoom(factor, x = size[0] / 2, y = size[1] / 2) {
    const before = scale();
    view.zoom = Math.min(Math.max(view.zoom * factor, 0.02), 2000);
    const after = scale();
    view.x += (x - size[0] / 2) * (1 / before - 1 / after);
    view.y -= (y - size[1] / 2) * (1 / before - 1 / after);
    changed();
  }

  function reset() {
    Object.assign(view, { x: 0, y: 0, zoom: 1 });
    changed();
  }

  const label = `${scene.case.title} from above: ${scene.tracks.length} trajectories${scene.truth ? " and the truth" : ""}. ` +
    "Arrow keys move, plus and minus zoom, 0 shows all.";
  const canvas = sharpCanvas({ class: "view", tabindex: "0", role: "img", "aria-label": label, "data-view": "top" }, draw);
  addGestures(canvas, {
    drag: pan,
    zoom,
    hover: (x, y, event) => hoverScene(scene, at, x, y, event),
    leave: hideHint,
    keys: {
      ArrowLeft: () => pan(40, 0), ArrowRight: () => pan(-40, 0), ArrowUp: () => pan(0, 40), ArrowDown: () => pan(0, -40),
      "+": () => zoom(1.25), "=": () => zoom(1.25), "-": () => zoom(0.8), 0: reset,
    },
  });
  const buttons = viewButtons([["+", "Zoom in", () => zoom(1.4)], ["−", "Zoom out", () => zoom(1 / 1.4)], ["⤢", "Show all", reset]]);
  return viewCard("From above", scene, canvas, buttons, "Drag to move; Ctrl and wheel, or two fingers, to zoom.");
}

/** A card with a view, its buttons and a line of help. */
function viewCard(title, scene, canvas, buttons, help) {
  const card = el("section", { class: "card view-card" });
  const bar = el("div", { class: "bar" }, el("h3", { text: title }), expandable(card, canvas, `${title}, ${scene.case.title}`));
  card.append(bar, el("div", { class: "view-frame" }, canvas, buttons), el("p", { class: "fine", text: help }));
  return card;
}
