/** A comparison over seeds: every seed's value of a metric, and errors and NEES averaged over the seeds. */
function seedsCase(one, columns) {
  const cards = [stripCard(one, columns)];
  if (one.rows.some((row) => row.errors)) {
    const describe = () => ({ ...errorLines(one, "position_m"), xLabel: "time [s]", yLabel: "position error [m]", unit: "m", least: 1e-3 });
    cards.push(chartCard(one, "Position error over the seeds, from the common start", describe,
      "Root mean square over the seeds that ended well at each frame. All start from the same pose and nothing is fitted."));
  }
  const rows = one.rows.filter((row) => row.nees);
  if (rows.length) {
    const describe = () => {
      const shown = rows.filter(isShown);
      const banded = (shown.length ? shown : rows)[0].nees;
      return {
        lines: rows.map((row) => ({ row, t: row.nees.t_s, x: row.nees.t_s, y: row.nees.pose })), xLabel: "time [s]",
        yLabel: "mean pose NEES / 6", unit: "", log: true, level: 1,
        band: { x: banded.t_s, low: banded.low, high: banded.high },
      };
    };
    cards.push(chartCard(one, "Is the stated uncertainty consistent? NEES", describe,
      "The shaded band, for as many seeds, contains 95 % of a consistent estimator's frames; the result for each estimator is stated below."));
  }
  return [el("div", { class: "charts" }, cards)];
}

function stripCard(one, columns) {
  const given = columns.filter((column) => one.rows.some((row) => row.values[column.key]?.some((value) => value !== null)));
  let column = given.find((c) => c.key === "ate_none_m") ?? given[0];
  const choose = dropdown("metric", given.map((c) => [c.key, c.unit ? `${c.name} [${c.unit}]` : c.name]), column.key, (key) => {
    column = given.find((c) => c.key === key);
    changed();
  });
  const canvas = sharpCanvas({ class: "chart", role: "img", "aria-label": `Each seed's value, ${one.title}`, "data-chart": "seeds" }, draw);
  let marks = [];

  function draw(context, width, height) {
    const rows = one.rows.filter(isShown);
    const values = rows.map((row) => row.values[column.key]);
    const [low, high] = rangeOf(values) ?? [0, 1];
    const axes = axesOf(width, height, [Math.min(low, 0), high * 1.05 || 1], [0, 1], false);
    drawAxes(context, axes, column.unit ? `${column.name} [${column.unit}]` : column.name, "");
    marks = [];
    rows.forEach((row, i) => {
      const y = axes.top + ((i + 0.5) * (axes.bottom - axes.top)) / rows.length;
      values[i].forEach((value, s) => {
        if (value === null) return;
        context.globalAlpha = 0.7;
        dot(context, [axes.px(value), y + ((s % 5) - 2) * 2.5], 4, ink(lookOf(row).colour));
        marks.push({ x: axes.px(value), y, row, seed: one.seeds[s], value, status: row.statuses[s] });
      });
      const mean = row.metrics[column.key];
      context.globalAlpha = 1;
      context.strokeStyle = ink("--text");
      context.lineWidth = 2;
      if (mean !== null) strokeLine(context, 2, (k) => [axes.px(mean), y + (k ? 10 : -10)]);
      context.fillStyle = ink("--text");
      context.fillText(labelOf(row), axes.left + 6, y - 13);
    });
  }

  canvas.addEventListener("pointermove", (event) => {
    const box = canvas.getBoundingClientRect();
    const [x, y] = [event.clientX - box.left, event.clientY - box.top];
    const near = marks.filter((mark) => Math.hypot(mark.x - x, mark.y - y) < 12)[0];
    if (!near) hideHint();
    else showHint([hintLine(near.row, `${shortText(near.value)} ${column.unit}`), `seed ${near.seed}: ${near.status}`], event.clientX, event.clientY);
  });
  canvas.addEventListener("pointerleave", hideHint);
  return el("section", { class: "card" }, el("div", { class: "bar" }, el("h3", { text: "Each seed's value" }), choose), canvas,
    el("p", { class: "fine", text: "One dot a seed, whatever its status; the stroke is the mean of those that ended well." }));
}
