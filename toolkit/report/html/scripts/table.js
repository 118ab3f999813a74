/**
 * The summary: one row a line of every case of a kind. Headers are buttons that sort, what is missing says why, and
 * the best of each recording is marked.
 */
function summaryTable(cases, columns, title) {
  const seeds = cases[0].kind === "seeds";
  const rows = cases.flatMap((one) => one.rows.map((row) => ({ ...row, case: one })));
  const words = [
    { name: "estimator", text: (row) => row.estimator },
    ...(cases.length > 1 ? [{ name: "recording", text: (row) => row.case.title }] : []),
    { name: "output", text: (row) => row.output, meaning: OUTPUT_MEANING },
    { name: "status", text: (row) => row.status, meaning: statusMeaning() },
    ...(rows.some((row) => row.change) ? [{ name: "change", text: (row) => row.change }] : []),
  ];
  let everything = false;
  let sorting = null; // { name, descending }
  const body = el("tbody");
  const head = el("thead");
  const table = el("table", {}, el("caption", { class: "unseen", text: title }), head, body);
  const given = columns.filter((c) => rows.some((row) => value(row, c) !== null));
  const shown = () => [...words, ...given.filter((c) => everything || (seeds ? c.usual_over_seeds : c.usual))];

  function value(row, column) {
    return row.metrics[column.key] ?? null;
  }

  function sort(column) {
    const descending = sorting !== null && sorting.name === column.name && !sorting.descending;
    sorting = { name: column.name, descending };
    const sign = descending ? -1 : 1;
    rows.sort((a, b) => {
      if (column.text) return sign * column.text(a).localeCompare(column.text(b));
      const [left, right] = [value(a, column), value(b, column)];
      if (left === null || right === null) return (left === null) - (right === null); // what is missing stays last
      return sign * (left - right);
    });
    fill();
    announce(`sorted by ${column.name}, ${descending ? "descending" : "ascending"}`);
  }

  function header(column) {
    const current = sorting !== null && sorting.name === column.name;
    const direction = current ? (sorting.descending ? "descending" : "ascending") : "none";
    const button = el("button", { type: "button", onclick: () => sort(column) },
      el("span", { text: column.name.replace(/(\d) (?=[ms]\b)/, "$1\u00a0") }),
      column.unit && column.unit !== "1" ? el("span", { class: "unit", text: ` [${column.shown_in.name}]` }) : null,
      el("span", { class: "arrow", "aria-hidden": "true", text: { none: "↕", ascending: "↑", descending: "↓" }[direction] }));
    if (column.meaning) hintOn(button, column.meaning);
    const attributes = { scope: "col", class: column.text ? "word" : "number", "aria-sort": direction };
    return el("th", { ...attributes, "data-key": column.key ?? column.name }, button);
  }

  function numberCell(row, column, best) {
    const number = value(row, column);
    const note = row.notes[column.key];
    if (number === null) {
      const why = note || "not computed";
      const cell = el("td", { class: "number missing" }, el("span", { "aria-hidden": "true", text: MISSING }),
        el("span", { class: "unseen", text: `no value: ${why}` }));
      hintOn(cell, `no value: ${why}`);
      return cell;
    }
    const text = cellText(number, column);
    const isBest = best.get(`${row.case.id} ${column.key}`) === text && row.status === "ok";
    const cell = el("td", { class: isBest ? "number best" : "number", "data-value": number });
    cell.append(text);
    const std = seeds ? row.spreads[column.key].std : null;
    if (std !== null && std > 0) cell.append(el("span", { class: "spread", text: ` ± ${Number((std * column.shown_in.factor).toPrecision(2))}` }));
    if (isBest) cell.append(el("span", { class: "unseen", text: " (best)" }));
    const exact = `${number} ${column.unit}`.trim();
    const told = [seeds ? `mean of ${row.spreads[column.key].n} seeds: ${exact}` : exact, note].filter(Boolean);
    hintOn(cell, told.join("; "));
    return cell;
  }

  function wordCell(row, column, i) {
    if (i === 0) {
      // On a phone these words take the place of their columns, so that numbers are seen at once.
      const rest = words.slice(1).map((other) => other.text(row)).filter((text) => text && text !== "ok");
      return el("th", { scope: "row", class: "word" }, swatch(row), el("span", { text: row.estimator }),
        el("small", { "aria-hidden": "true", text: [...rest, row.mark].filter(Boolean).join(", ") }));
    }
    const text = column.text(row);
    if (column.name !== "status") return el("td", { class: "word", text });
    const mark = row.mark ? [" ", el("span", { class: "status mark", text: row.mark })] : [];
    return el("td", { class: "word" }, el("span", { class: text === "ok" ? "status ok" : "status bad", text }), ...mark);
  }

  function fill() {
    const current = shown();
    const refocus = head.contains(document.activeElement) ? document.activeElement.closest("th").dataset.key : null;
    head.replaceChildren(el("tr", {}, current.map(header)));
    if (refocus !== null) head.querySelector(`th[data-key="${CSS.escape(refocus)}"] button`)?.focus();
    const best = bestValues(rows, given);
    body.replaceChildren(...rows.map((row) => {
      const cells = current.map((column, i) =>
        column.text ? wordCell(row, column, i) : numberCell(row, column, best));
      const line = el("tr", { "data-row": row.id }, cells);
      line.addEventListener("pointerenter", () => pointAt(keyOf(row)));
      line.addEventListener("pointerleave", () => pointAt(null));
      return line;
    }));
    mark();
  }

  function mark() {
    rows.forEach((row, i) => {
      const line = body.children[i];
      line.classList.toggle("off", !isShown(row));
      line.classList.toggle("pointed", state.pointed === keyOf(row));
    });
  }

  const more = el("button", { type: "button", class: "quiet", "aria-pressed": "false", text: "All metrics",
    onclick: () => {
      everything = !everything;
      more.setAttribute("aria-pressed", String(everything));
      fill();
    } });
  fill();
  listen(mark);
  const frame = el("div", { class: "table-frame", role: "region", tabindex: "0", "aria-label": title }, table);
  return el("div", {}, el("div", { class: "bar" }, el("h2", { text: title }), more), frame,
    el("p", { class: "fine", text: TABLE_NOTE + (seeds ? " Means over the seeds that ended well, ± one standard deviation." : "") }));
}

/**
 * Return how the best value of each metric of each case prints, among the rows that ended well; none where there is no
 * choice, or where another that prints alike is worse.
 */
function bestValues(rows, columns) {
  const distance = { least: (v) => Math.abs(v), most: (v) => -v, one: (v) => Math.abs(Math.log(Math.max(v, 1e-300))) };
  const best = new Map();
  for (const column of columns.filter((c) => c.best)) {
    for (const id of new Set(rows.map((row) => row.case.id))) {
      const ok = rows.filter((row) => row.case.id === id && row.status === "ok");
      const values = ok.map((row) => row.metrics[column.key]).filter((v) => v !== null && v !== undefined);
      if (new Set(values.map((v) => cellText(v, column))).size < 2) continue;
      const least = values.reduce((a, b) => (distance[column.best](b) < distance[column.best](a) ? b : a));
      const text = cellText(least, column);
      if (values.every((v) => v === least || cellText(v, column) !== text)) best.set(`${id} ${column.key}`, text);
    }
  }
  return best;
}
