/** One run directory: its views with a cursor through time, its charts and its words. */
function caseSection(one) {
  const parts = one.kind === "seeds" ? seedsCase(one, payload.columns) : runParts(one);
  return [parts, wordsOf(one)];
}

/** What is said of a case before any figure: what was recorded, what went wrong, and the answers looked for first. */
function glance(one) {
  const [name, ...rest] = one.words.sequence.split(": ");
  const { verdict } = one.words;
  return [
    el("p", { class: "lead", text: rest.length ? rest.join(": ") : name }), troubles(one),
    verdict ? el("p", { class: "verdict", text: verdict }) : null, highlightTiles(one),
  ];
}

/** Say in words, before any figure, who did not end well. */
function troubles(one) {
  const bad = new Map(one.rows.filter((row) => row.status !== "ok" && row.status in payload.statuses).map((row) => [row.estimator, row]));
  if (!bad.size) return null;
  return el("div", { class: "card trouble", role: "note" }, el("ul", {}, [...bad.values()].map((row) =>
    el("li", {}, el("b", { text: row.estimator }), ` ${row.status}: it ${payload.statuses[row.status]}${row.log?.length ? ` (${row.log[row.status === "failed" ? 0 : row.log.length - 1]})` : ""}.`))));
}

function highlightTiles(one) {
  if (!one.highlights?.length) return null;
  return el("div", { class: "tiles" }, one.highlights.map((tile) => {
    const row = one.rows.find((other) => other.id === tile.row);
    const pointing = row ? { onpointerenter: () => pointAt(keyOf(row)), onpointerleave: () => pointAt(null) } : {};
    return el("div", { class: "tile", ...pointing },
      el("span", { class: "question", text: tile.question }), el("b", {}, row ? swatch(row) : null, tile.answer),
      el("span", { text: tile.detail }));
  }));
}

function runParts(one) {
  const scene = sceneOf(one);
  const maps = [["", "no landmarks"], ...one.maps.map((map) => [map.estimator, `of ${map.estimator} (${map.count})`])];
  const chooseMap = one.maps.length ? dropdown("landmarks", maps, scene.map, (name) => {
    scene.map = name;
    changed();
  }) : null;
  const over = segmented("Errors over", [["path", "distance"], ["time", "time"]], () => state.over, (value) => {
    state.over = value;
    changed();
  });
  return [
    el("div", { class: "bar" }, el("h3", { text: "Where they went" }), chooseMap),
    el("p", { class: "fine", text: one.alignment }),
    el("div", { class: "figures" },
      el("div", { class: "views" }, topView(scene), orbitView(scene)),
      el("div", { class: "bar" }, el("h3", { text: "How they did along the way" }),
        one.error ? el("div", { class: "choice" }, el("span", { text: "errors over" }), over) : null),
      el("div", { class: "charts" }, chartsOf(one)),
      scrubber(one)),
  ];
}

/** A cursor through the recording that every view and chart follows: drag it, use the arrow keys, or let it run. */
function scrubber(one) {
  const last = Math.max(one.sequence.duration_s, 1e-3);
  const slider = el("input", { type: "range", min: 0, max: last, step: last / 1000, value: 0, "aria-label": `Time in ${one.title}`,
    oninput: () => setCursor(one.id, Number(slider.value)) });
  const told = el("output", { class: "readout" });
  const play = el("button", { type: "button", text: "▶", "aria-label": "Play", onclick: () => (ticking ? stop() : start()) });
  const whole = el("button", { type: "button", class: "quiet", text: "Whole recording", onclick: () => setZoom(one.id, null), hidden: true });
  let ticking = null;

  function start() {
    const began = performance.now();
    const from = Number(slider.value) >= last ? 0 : Number(slider.value);
    const speed = last / 12; // a recording in twelve seconds
    const step = (now) => {
      const t = from + ((now - began) / 1000) * speed;
      setCursor(one.id, Math.min(t, last));
      if (t < last) ticking = requestAnimationFrame(step);
      else stop();
    };
    ticking = requestAnimationFrame(step);
    play.textContent = "❚❚";
    play.setAttribute("aria-label", "Pause");
  }

  function stop() {
    cancelAnimationFrame(ticking);
    ticking = null;
    play.textContent = "▶";
    play.setAttribute("aria-label", "Play");
  }

  function show() {
    const t = state.cursor.get(one.id) ?? 0;
    if (document.activeElement !== slider || Math.abs(slider.value - t) > last / 900) slider.value = t;
    const walked = pathAt(one, t);
    told.textContent = `${t.toFixed(1)} s${walked === null ? "" : `, ${walked.toFixed(0)} m`}`;
    slider.setAttribute("aria-valuetext", told.textContent);
    whole.hidden = !state.zoom.has(one.id);
  }
  listen(show);
  show();
  return el("div", { class: "card scrubber" }, play, slider, told, whole);
}

function pathAt(one, t) {
  const errors = one.rows.map((row) => row.errors).find((given) => given && given.t_s.length);
  return errors ? errors.path_m[nearestIndex(errors.t_s, t)] : null;
}
