/**
 * A chart of lines over time or distance with the cursor of its case. ``describe()`` gives what to draw now:
 * { lines: [{ row, t, x, y }], xLabel, yLabel, unit, log, band: { x, low, high } or [low, high], level, dots }; where there
 * are dots, lines have a median to be drawn through them.
 */
function chart(one, title, describe) {
  let axes = null;
  let picture = null;
  let selection = null; // while a range is dragged: [from, to] on the canvas

  function inZoom(line) {
    const zoom = state.zoom.get(one.id);
    if (!zoom) return line;
    const kept = line.t.map((t, i) => i).filter((i) => line.t[i] >= zoom[0] && line.t[i] <= zoom[1]);
    const part = (list) => kept.map((i) => list[i]);
    return { ...line, t: part(line.t), x: part(line.x), y: part(line.y), median: line.median && part(line.median) };
  }

  function draw(context, width, height) {
    picture = describe();
    picture.lines = picture.lines.filter((line) => isShown(line.row)).map(inZoom);
    axes = axesOf(width, height, xRange(picture), yRange(picture), picture.log);
    drawAxes(context, axes, picture.xLabel, picture.yLabel);
    if (!picture.lines.some((line) => line.x.length)) {
      context.fillText("nothing shown: switch a line on in the legend", axes.left + 12, axes.top + 24);
      return;
    }
    context.save();
    context.beginPath();
    context.rect(axes.left, axes.top - 4, axes.right - axes.left, axes.bottom - axes.top + 8);
    context.clip();
    drawBand(context, axes, picture);
    picture.lines.forEach((line, i) => drawLine(context, axes, line, picture, 2.4 - (1.2 * i) / Math.max(picture.lines.length - 1, 1)));
    drawCursorLine(context);
    context.restore();
  }

  function drawCursorLine(context) {
    context.globalAlpha = 1;
    context.setLineDash([]);
    if (selection) {
      context.fillStyle = ink("--selection");
      context.fillRect(Math.min(...selection), axes.top, Math.abs(selection[1] - selection[0]), axes.bottom - axes.top);
    }
    const t = state.cursor.get(one.id);
    if (t === undefined) return;
    const x = xOf(picture, t);
    context.strokeStyle = ink("--faint");
    context.lineWidth = 1;
    if (x !== null) strokeLine(context, 2, (i) => [axes.px(x), i ? axes.bottom : axes.top]);
    for (const line of picture.lines) {
      if (!line.t.length) continue;
      const i = nearestIndex(line.t, t);
      if (line.y[i] !== null && line.x[i] !== null) dot(context, [axes.px(line.x[i]), axes.py(line.y[i])], 3.5, ink(lookOf(line.row).colour));
    }
  }

  function hover(x, y, event) {
    if (axes === null || picture === null) return;
    const t = tAt(picture, axes.fromPx(Math.min(Math.max(x, axes.left), axes.right)));
    if (t === null) return;
    setCursor(one.id, t);
    const values = picture.lines.filter((line) => line.t.length).map((line) => [line.row, line.y[nearestIndex(line.t, t)]]);
    values.sort((a, b) => (b[1] ?? -Infinity) - (a[1] ?? -Infinity));
    const lines = values.map(([row, value]) => hintLine(row, `${shortText(value)}${picture.unit ? ` ${picture.unit}` : ""}`));
    showHint([`${t.toFixed(2)} s`, ...lines], event.clientX, event.clientY);
  }

  const label = `${title}, ${one.title}. The values are in the summary table; the cursor below the views reads them along the way.`;
  const canvas = sharpCanvas({ class: "chart", role: "img", "aria-label": label, "data-chart": title }, draw);
  let from = null;
  canvas.addEventListener("pointerdown", (event) => {
    const x = event.clientX - canvas.getBoundingClientRect().left;
    if (event.pointerType === "mouse") {
      from = x;
      canvas.setPointerCapture(event.pointerId);
    }
    hover(x, 0, event);
  });
  canvas.addEventListener("pointermove", (event) => {
    const x = event.clientX - canvas.getBoundingClientRect().left;
    if (from !== null && Math.abs(x - from) > 6) selection = [from, x];
    hover(x, 0, event);
    if (selection) changed();
  });
  canvas.addEventListener("pointerup", () => {
    if (selection && axes) {
      const [a, b] = selection.map((x) => tAt(picture, axes.fromPx(x))).sort((p, q) => p - q);
      if (a !== null && b > a) setZoom(one.id, [a, b]);
    }
    from = null;
    selection = null;
    changed();
  });
  canvas.addEventListener("pointerleave", hideHint);
  canvas.addEventListener("dblclick", () => setZoom(one.id, null));
  return canvas;
}

function xRange(picture) {
  return rangeOf(picture.lines.map((line) => line.x)) ?? [0, 1];
}

/** The range of the values; one that diverged gets no more than half as much again as those that ended well need. */
function yRange(picture) {
  const good = picture.lines.filter((line) => line.row.status === "ok");
  const all = rangeOf(picture.lines.map((line) => line.y)) ?? [picture.log ? 0.1 : 0, 1];
  let [low, high] = all;
  const needed = rangeOf(good.map((line) => line.y));
  if (needed && good.length < picture.lines.length && !picture.log) {
    const room = 1.5 * Math.max(Math.abs(needed[0]), Math.abs(needed[1]), 1e-3);
    [low, high] = [Math.max(low, needed[0] < 0 ? -room : low), Math.min(high, room)];
    if (picture.signed) low = Math.max(low, -room);
  }
  if (picture.level !== undefined) [low, high] = [Math.min(low, picture.level), Math.max(high, picture.level)];
  if (Array.isArray(picture.band)) high = Math.max(high, picture.band[1]);
  if (picture.log) return logRange(low, high);
  if (picture.signed && picture.band) [low, high] = withBand(low, high, picture.band);
  const least = picture.least ?? 1e-6; // what agrees to rounding shall look so
  if (picture.signed) return [Math.min(low, -least) * 1.05, Math.max(high, least) * 1.05];
  return [0, Math.max(high, least) * 1.05];
}

/** The range with the band in it, unless that would flatten the lines. */
function withBand(low, high, band) {
  const [least, most] = rangeOf([band.low, band.high]) ?? [0, 0];
  const reach = 6 * Math.max(Math.abs(low), Math.abs(high));
  return [Math.min(low, Math.max(least, -reach)), Math.max(high, Math.min(most, reach))];
}

/** At least a decade, so that jitter does not look like drama; at most nine below the top. */
function logRange(low, high) {
  const top = Math.max(high, 1e-9) * 1.15;
  const bottom = Math.max(low / 1.15, top * 1e-9);
  const widen = Math.max(1, Math.sqrt((10 * bottom) / top));
  return [bottom / widen, top * widen];
}

function drawBand(context, axes, picture) {
  context.fillStyle = ink("--band");
  if (Array.isArray(picture.band)) {
    const [low, high] = picture.band;
    context.fillRect(axes.left, axes.py(high), axes.right - axes.left, axes.py(low) - axes.py(high));
  } else if (picture.band) {
    const { x, low, high } = picture.band;
    context.beginPath();
    x.forEach((value, i) => high[i] !== null && context.lineTo(axes.px(value), axes.py(high[i])));
    for (let i = x.length - 1; i >= 0; i--) if (low[i] !== null) context.lineTo(axes.px(x[i]), axes.py(low[i]));
    context.fill();
  }
  if (picture.level !== undefined) {
    context.strokeStyle = ink("--faint");
    context.setLineDash([3, 3]);
    context.lineWidth = 1;
    strokeLine(context, 2, (i) => [i ? axes.right : axes.left, axes.py(picture.level)]);
  }
}

function drawLine(context, axes, line, picture, width) {
  lineStyle(context, line.row, width);
  if (picture.dots) {
    context.fillStyle = context.strokeStyle;
    context.globalAlpha *= 0.35;
    line.y.forEach((value, i) => value !== null && context.fillRect(axes.px(line.x[i]) - 1.25, axes.py(value) - 1.25, 2.5, 2.5));
    context.globalAlpha = state.pointed === null || state.pointed === keyOf(line.row) ? 1 : 0.35;
  }
  const values = picture.dots ? line.median : line.y;
  const jumps = (i) => picture.wraps && i > 0 && Math.abs(values[i] - values[i - 1]) > 180;
  strokeLine(context, values.length, (i) => (values[i] === null || jumps(i) ? null : [axes.px(line.x[i]), axes.py(values[i])]));
  context.globalAlpha = 1;
}

/** Where a time lies on the horizontal axis, by the line that knows most; and the other way round. */
function xOf(picture, t) {
  const line = longest(picture);
  return line === null ? null : line.x[nearestIndex(line.t, t)];
}

function tAt(picture, x) {
  const line = longest(picture);
  return line === null ? null : line.t[nearestIndex(line.x, x)];
}

function longest(picture) {
  const known = picture.lines.filter((line) => line.t.length);
  return known.length ? known.reduce((a, b) => (b.t.length > a.t.length ? b : a)) : null;
}
