const payload = JSON.parse(document.getElementById("payload").textContent);

/** Every line of every case once, in order of appearance. */
function linesOf(cases) {
  const lines = new Map();
  for (const row of cases.flatMap((one) => one.rows)) if (!lines.has(keyOf(row))) lines.set(keyOf(row), row);
  return lines;
}

/** The legend stays in sight: each line can be switched off and on everywhere at once. */
function legend(cases) {
  const lines = linesOf(cases);
  const keys = [...lines.keys()];
  const chips = [...lines].map(([key, row]) => {
    const chip = el("button", { type: "button", class: "chip", "data-line": key,
      onclick: (event) => toggleLine(key, keys, event.shiftKey), onpointerenter: () => pointAt(key), onpointerleave: () => pointAt(null),
      onfocus: () => chip.matches(":focus-visible") && pointAt(key), onblur: () => pointAt(null) }, swatch(row), el("span", { text: labelOf(row) }));
    return chip;
  });
  const all = el("button", { type: "button", class: "chip plain", text: "Show all", onclick: () => {
    state.hidden.clear();
    changed();
  } });
  const mark = () => {
    chips.forEach((chip) => chip.setAttribute("aria-pressed", String(!state.hidden.has(chip.dataset.line))));
    all.hidden = state.hidden.size === 0;
  };
  listen(mark);
  mark();
  const truth = cases.some((one) => one.truth) ? el("span", { class: "chip truth" }, el("i", { "aria-hidden": "true" }), "truth") : null;
  return el("div", { class: "legend", role: "group", "aria-label": "Lines shown in all figures; with Shift only this one" }, truth, chips, all);
}

const THEME = "vislam-report-theme";

function storedTheme() {
  try {
    return localStorage.getItem(THEME);
  } catch {
    return null; // a page opened from disk may not be allowed to remember
  }
}

/** Light or dark as the system says, or as the reader says. */
function themeButton() {
  const system = matchMedia("(prefers-color-scheme: dark)");
  const root = document.documentElement;
  const isDark = () => (root.dataset.theme ? root.dataset.theme === "dark" : system.matches);
  const button = el("button", { type: "button", class: "quiet theme", onclick: () => {
    root.dataset.theme = isDark() ? "light" : "dark";
    try {
      localStorage.setItem(THEME, root.dataset.theme);
    } catch {
      // not remembered then
    }
    show();
  } });
  function show() {
    button.textContent = isDark() ? "☀ Light" : "☾ Dark";
    button.setAttribute("aria-label", isDark() ? "Switch to the light theme" : "Switch to the dark theme");
    forgetInks();
  }
  if (storedTheme()) root.dataset.theme = storedTheme();
  system.addEventListener("change", show);
  show();
  return button;
}

function oneCase(one, tables) {
  return [
    el("div", { class: "case glance" }, glance(one)), legend([one]), tables,
    el("section", { class: "case only", id: one.id, "aria-label": one.title }, caseSection(one)),
  ];
}

/** Several cases stand side by side under one table and one legend. */
function severalCases(cases, tables) {
  const columns = cases.map((one) => el("section", { class: "case", id: one.id, "aria-labelledby": `case-${one.id}` },
    el("h2", { id: `case-${one.id}`, text: one.title }), glance(one), caseSection(one)));
  return [legend(cases), tables, el("div", { class: "cases" }, columns)];
}

function build() {
  const { cases, columns } = payload;
  const kinds = [["run", "Summary"], ["seeds", "Summary over seeds"]];
  const tables = kinds.map(([kind, title]) => [cases.filter((one) => one.kind === kind), title])
    .filter(([some]) => some.length).map(([some, title]) => el("section", { class: "card summary" }, summaryTable(some, columns, title)));
  if (tables.length) tables[0].id = "summary";
  const jumps = cases.length > 1 ? el("nav", { "aria-label": "Recordings" }, cases.map((one) => el("a", { href: `#${one.id}`, text: one.title }))) : null;
  document.getElementById("page").append(
    el("header", { class: "top" }, el("div", {}, el("span", { class: "brand", text: "vislam report" }), el("h1", { text: payload.title })), jumps, themeButton()),
    el("main", {}, cases.length > 1 ? severalCases(cases, tables) : cases.map((one) => oneCase(one, tables)), [...document.querySelectorAll(".results")]),
    el("footer", { text: "Everything on this page is in this file; nothing is fetched. One recording is one sample: for a verdict between estimators, repeat it over seeds or on more recordings." }),
    hint,
  );
}

build();
