/** Return about ``count`` round values that cover a range. */
function ticksOf(low, high, count) {
  const rough = (high - low) / Math.max(count, 1);
  if (!(rough > 0)) return [low];
  const power = 10 ** Math.floor(Math.log10(rough));
  const step = power * [1, 2, 5, 10].find((factor) => factor * power >= rough * 0.999);
  const ticks = [];
  for (let n = Math.ceil(low / step - 1e-9); n * step <= high + step * 1e-9; n++) ticks.push(Number((n * step).toPrecision(12)));
  return ticks;
}

/** Return the powers of ten in a range, with their halves and fifths where there are few. */
function logTicksOf(low, high) {
  const ticks = [];
  const narrow = high / low < 300;
  for (let p = Math.floor(Math.log10(low)) - 1; p <= Math.ceil(Math.log10(high)); p++) {
    for (const factor of narrow ? [1, 2, 5] : [1]) {
      const tick = Number((factor * 10 ** p).toPrecision(6));
      if (tick >= low && tick <= high) ticks.push(tick);
    }
  }
  return ticks;
}

/**
 * Axes of a chart: where it lies on the canvas, and the two mappings. ``x`` and ``y`` are ranges, ``log`` is of y.
 */
function axesOf(width, height, x, y, log) {
  const frame = { left: 58, right: width - 10, top: 12, bottom: height - 38 };
  const along = (value, [low, high], from, to) => from + ((value - low) / (high - low || 1)) * (to - from);
  const up = log ? (value) => Math.log10(Math.max(value, y[0] / 10)) : (value) => value;
  return {
    ...frame, x, y, log,
    px: (value) => along(value, x, frame.left, frame.right),
    py: (value) => along(up(value), [up(y[0]), up(y[1])], frame.bottom, frame.top),
    fromPx: (px) => x[0] + ((px - frame.left) / (frame.right - frame.left)) * (x[1] - x[0]),
  };
}

/** Draw ticks, grid and labels; without a label, the vertical axis has no ticks either. */
function drawAxes(context, axes, xLabel, yLabel) {
  context.lineWidth = 1;
  context.setLineDash([]);
  context.fillStyle = ink("--faint");
  const yTicks = !yLabel ? [] : axes.log ? logTicksOf(...axes.y) : ticksOf(...axes.y, (axes.bottom - axes.top) / 45);
  context.textAlign = "right";
  for (const tick of yTicks) {
    context.strokeStyle = ink("--grid");
    strokeLine(context, 2, (i) => [i ? axes.right : axes.left, axes.py(tick)]);
    context.fillText(tickText(tick), axes.left - 6, axes.py(tick) + 4);
  }
  context.textAlign = "center";
  for (const tick of ticksOf(...axes.x, (axes.right - axes.left) / 90)) {
    context.strokeStyle = ink("--grid");
    strokeLine(context, 2, (i) => [axes.px(tick), i ? axes.bottom : axes.bottom + 4]);
    context.fillText(tickText(tick), axes.px(tick), axes.bottom + 17);
  }
  context.fillStyle = ink("--text");
  context.fillText(xLabel, (axes.left + axes.right) / 2, axes.bottom + 34);
  context.save();
  context.translate(11, (axes.top + axes.bottom) / 2);
  context.rotate(-Math.PI / 2);
  // A label longer than the axis is set narrower: the canvas would cut it.
  context.fillText(yLabel, 0, 0, axes.bottom - axes.top + 24);
  context.restore();
  context.textAlign = "left";
}
