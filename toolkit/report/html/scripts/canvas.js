/** A canvas that is as sharp as the screen, as wide as its place, and drawn again whenever that or the state changes. */
function sharpCanvas(attributes, draw) {
  const canvas = el("canvas", attributes);
  const context = canvas.getContext("2d");
  const redraw = () => {
    const { clientWidth: width, clientHeight: height } = canvas;
    if (!width || !height) return;
    const ratio = window.devicePixelRatio || 1;
    if (canvas.width !== Math.round(width * ratio) || canvas.height !== Math.round(height * ratio)) {
      canvas.width = Math.round(width * ratio);
      canvas.height = Math.round(height * ratio);
    }
    context.setTransform(ratio, 0, 0, ratio, 0, 0);
    context.clearRect(0, 0, width, height);
    context.font = `12px ${fontFamily()}`;
    draw(context, width, height);
  };
  new ResizeObserver(redraw).observe(canvas);
  listen(redraw);
  return canvas;
}

let inks = new Map();

/** Return the colour of a custom property of the style sheet in the present theme. */
function ink(name) {
  if (!inks.has(name)) inks.set(name, getComputedStyle(document.documentElement).getPropertyValue(name).trim());
  return inks.get(name);
}

function forgetInks() {
  inks = new Map();
  changed();
}

let family = null;
function fontFamily() {
  family ??= getComputedStyle(document.body).fontFamily;
  return family;
}

/** Draw a line through points given by functions of the index; a null breaks it. */
function strokeLine(context, count, at) {
  context.beginPath();
  let pen = false;
  for (let i = 0; i < count; i++) {
    const point = at(i);
    if (point === null) pen = false;
    else if (pen) context.lineTo(point[0], point[1]);
    else {
      context.moveTo(point[0], point[1]);
      pen = true;
    }
  }
  context.stroke();
}

function dot(context, [x, y], radius, fill) {
  context.beginPath();
  context.arc(x, y, radius, 0, 2 * Math.PI);
  context.fillStyle = fill;
  context.fill();
  context.strokeStyle = ink("--card");
  context.lineWidth = 1.5;
  context.setLineDash([]);
  context.stroke();
}

/** Set how a row's line is drawn; what is pointed at stands out, the others step back. */
function lineStyle(context, row, width) {
  const look = lookOf(row);
  const pointed = state.pointed === keyOf(row);
  context.strokeStyle = ink(look.colour);
  context.setLineDash(look.dash);
  context.lineWidth = pointed ? width + 1.5 : width;
  context.globalAlpha = state.pointed === null || pointed ? 1 : 0.35;
  context.lineJoin = "round";
}
