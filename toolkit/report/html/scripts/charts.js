/** The charts of a case: each with a sentence under it, or the reason why there is none. */
function chartsOf(one) {
  const cards = one.error ? [positionCard(one), headingCard(one), componentsCard(one)] : [];
  cards.push(neesCard(one), nisCard(one), stepsCard(one));
  return cards.filter((card) => card !== null);
}

function chartCard(one, title, describe, caption, ...controls) {
  return el("section", { class: "card" }, el("div", { class: "bar" }, el("h3", { text: title }), controls),
    chart(one, title, describe), el("p", { class: "fine", text: caption }));
}

function emptyCard(title, reasons) {
  return el("section", { class: "card empty" }, el("h3", { text: title }), el("p", { class: "fine", text: "No figures for it:" }),
    el("ul", { class: "fine" }, reasons.map((reason) => el("li", { text: reason }))));
}

/** Errors over distance or time, as the reader chose. */
function errorLines(one, name) {
  const overPath = state.over === "path";
  const lines = one.rows.filter((row) => row.errors).map((row) => ({
    row, t: row.errors.t_s, x: overPath && row.errors.path_m ? row.errors.path_m : row.errors.t_s, y: row.errors[name],
  }));
  return { lines, xLabel: overPath && one.kind === "run" ? "distance along the path [m]" : "time [s]" };
}

/** Say whether the largest errors of the lines lie so far apart that only a logarithmic axis shows them all. */
function farApart(lines) {
  const largest = lines.map((line) => rangeOf([line.y])?.[1]).filter((most) => most > 0);
  return Math.max(...largest) > 30 * Math.min(...largest);
}

/** What is drawn, and how the estimates are placed. */
function titled(one, name) {
  return [`${name} ${one.error.what}`, one.error.placing].filter(Boolean).join(", ");
}

function positionCard(one) {
  let log = farApart(errorLines(one, "position_m").lines);
  const toggle = el("button", { type: "button", class: "quiet", text: "log", "aria-pressed": String(log),
    "aria-label": "Logarithmic axis", onclick: () => {
      log = !log;
      toggle.setAttribute("aria-pressed", String(log));
      changed();
    } });
  const what = one.error.what;
  const describe = () => ({ ...errorLines(one, "position_m"), yLabel: `${what.split(" ")[0]} [m]`, unit: "m", log, least: 1e-3 });
  return chartCard(one, titled(one, "Position"), describe, one.error.caption, toggle);
}

function headingCard(one) {
  const what = one.error.what;
  const describe = () => ({ ...errorLines(one, "heading_deg"), yLabel: `${what.split(" ")[0]} [deg]`, unit: "deg", signed: true, wraps: true, least: 1e-2 });
  return chartCard(one, titled(one, "Heading"), describe, "Positive is turned to the left of where it should be.");
}

const COMPONENTS = [["x_m", "x"], ["y_m", "y"], ["z_m", "z"], ["about_x_deg", "about x"], ["about_y_deg", "about y"], ["about_z_deg", "about z"]];

/** One estimate's error along or about one of the world's axes, with three standard deviations that it states. */
function componentsCard(one) {
  const rows = one.rows.filter((row) => row.components);
  if (!rows.length) return null;
  // First the least consistent: its error beside what it states is what a reader wants explained.
  const off = (other) => Math.abs(Math.log(other.metrics.nees_pose_mean ?? 1));
  const good = rows.filter((other) => other.status === "ok");
  let row = (good.length ? good : rows).reduce((a, b) => (off(b) >= off(a) ? b : a));
  let name = "x_m";
  const chooseRow = rows.length > 1 ? dropdown("of", rows.map((other) => [other.id, labelOf(other)]), row.id, (id) => {
    row = rows.find((other) => other.id === id);
    changed();
  }) : null;
  const chooseName = dropdown("by", COMPONENTS, name, (value) => {
    name = value;
    changed();
  });
  const describe = () => {
    const { t_s, [name]: error, [`sigma_${name}`]: sigma } = row.components;
    const unit = name.endsWith("_m") ? "m" : "deg";
    const words = COMPONENTS.find(([key]) => key === name)[1];
    const side = (times) => sigma.map((value) => (value === null ? null : times * value));
    return {
      lines: [{ row, t: t_s, x: t_s, y: error }], xLabel: "time [s]", yLabel: `${words} [${unit}]`,
      unit, signed: true, least: 1e-3, level: 0, band: { x: t_s, low: side(-3), high: side(3) },
    };
  };
  return chartCard(one, "By component, with ±3σ", describe, "Along and about the world's axes, not aligned; a start outside the " +
    "truth's world is placed by its first pose. Shaded: three standard deviations as stated; a consistent estimate is inside nearly always.", chooseRow, chooseName);
}

const NEES_PARTS = [["pose", "pose"], ["orientation", "rotation"], ["position", "position"]];

function neesCard(one) {
  const title = "Is the stated uncertainty consistent? NEES";
  const rows = one.rows.filter((row) => row.nees && typeof row.nees === "object");
  if (!rows.length) return emptyCard(title, reasonsOf(one.rows, "nees"));
  let part = "pose";
  const choose = dropdown("of the", NEES_PARTS, part, (value) => {
    part = value;
    changed();
  });
  const describe = () => ({
    lines: rows.map((row) => ({ row, t: row.nees.t_s, x: row.nees.t_s, y: row.nees[part] })),
    xLabel: "time [s]", yLabel: "NEES / its dimension", unit: "", log: true, level: 1,
    band: part === "pose" ? rows[0].nees.band : undefined,
  });
  return chartCard(one, title, describe, "Squared error over what the estimator stated for it: 1 is consistent, above the shaded " +
    "95 % band of one run it is overconfident, below it timid." + missingWords(one.rows, "nees"), choose);
}

function nisCard(one) {
  const title = "Do the measurements agree? NIS";
  const rows = one.rows.filter((row) => row.nis && typeof row.nis === "object");
  if (!rows.length) return emptyCard(title, reasonsOf(one.rows, "nis"));
  const describe = () => {
    const shown = rows.filter(isShown);
    const banded = (shown.length ? shown : rows)[0].nis;
    return {
      lines: rows.map((row) => ({ row, t: row.nis.t_s, x: row.nis.t_s, y: row.nis.per_dof, median: row.nis.median })),
      xLabel: "time [s]", yLabel: "NIS / its dimension", unit: "", log: true, level: 1, dots: true,
      band: { x: banded.t_s, low: banded.low, high: banded.high },
    };
  };
  return chartCard(one, title, describe, "Squared innovation over what the filter expected of it at each frame (dots) and its running median (line); the shaded 95 % band is for as many " +
    "measurements as the first line shown had at each frame. It needs no truth." + missingWords(one.rows, "nis"));
}

function stepsCard(one) {
  if (!one.steps.length) return emptyCard("Time per frame", ["no estimator was run here"]);
  const timed = one.steps.map((step) => ({ ...step, row: one.rows.find((row) => step.rows.includes(row.id)) })).filter((step) => step.row);
  const describe = () => ({
    lines: timed.map((step) => ({ row: step.row, t: step.t_s, x: step.t_s, y: step.step_ms, median: step.median })),
    xLabel: "time in the recording [s]", yLabel: "time of a step [ms]", unit: "ms", log: true, dots: true,
  });
  const late = timed.filter((step) => step.finish_s * 1e3 > step.step_ms.reduce((a, b) => a + b, 0));
  const finish = late.map((step) => ` ${step.estimator} does its work at the end: ${shortText(step.finish_s)} s.`).join("");
  return chartCard(one, "Time per frame", describe, `Wall clock of each step (dots) and its running median (line).${finish}`);
}

/** Why rows have no series, each reason once, with whom it is about. */
function reasonsOf(rows, name) {
  const byReason = new Map();
  for (const row of rows.filter((other) => typeof other[name] === "string"))
    byReason.set(row[name], [...(byReason.get(row[name]) ?? []), labelOf(row)]);
  return [...byReason].map(([reason, names]) => (names.length === rows.length ? reason : `${names.join(", ")}: ${reason}`));
}

function missingWords(rows, name) {
  const reasons = reasonsOf(rows, name);
  return reasons.length ? ` Not shown: ${reasons.join("; ")}.` : "";
}
