/** Images of the recording with their tracks, coloured by how far off one estimator's poses leave each of them. */
const OFF_COLOURS = ["#2563eb", "#06b6d4", "#facc15", "#f97316", "#dc2626"];
const OFF_MOST_PX = 2;
const FRAMES_NOTE = "Each circle is a sighting. Its colour is its distance from the position predicted by the track's other sightings and the estimated poses; white: fewer than three sightings. Much red on one thing: it moves, or its tracks drift. Red everywhere: the poses are off.";

function framesOf(one) {
  if (!one.frames?.length) return null;
  const rows = one.rows.filter((row) => one.frames.some((frame) => frame.off[row.id]));
  const chosen = { row: rows.length ? bestExplaining(one, rows) : null };
  const choice = rows.length > 1 ? dropdown("coloured by", rows.map((row) => [row.id, labelOf(row)]), chosen.row.id, (id) => {
    chosen.row = rows.find((row) => row.id === id);
    changed();
  }) : null;
  return [
    el("div", { class: "bar" }, el("h3", { text: "What the camera saw" }), choice),
    el("p", { class: "fine", text: FRAMES_NOTE }),
    rows.length ? el("p", { class: "scale" }, "0 px", el("i", { "aria-hidden": "true" }), `${OFF_MOST_PX} px and more`) : null,
    el("div", { class: "views" }, one.frames.map((frame) => cameraFigure(one, frame, chosen))),
  ];
}

/** The row to begin with: the one whose poses explain the sightings best. */
function bestExplaining(one, rows) {
  const median = (row) => {
    const known = one.frames.flatMap((frame) => frame.off[row.id] ?? []).filter((px) => px !== null).sort((a, b) => a - b);
    return known.length ? known[known.length >> 1] : Infinity;
  };
  return rows.reduce((best, row) => (median(row) < median(best) ? row : best));
}

function cameraFigure(one, frame, chosen) {
  const [width, height] = frame.size;
  const image = new Image();
  image.addEventListener("load", changed);
  image.src = frame.image;
  const off = () => (chosen.row ? frame.off[chosen.row.id] : null) ?? [];

  function draw(context, shownWidth, shownHeight) {
    const scale = shownWidth / width;
    if (image.complete) context.drawImage(image, 0, 0, shownWidth, shownHeight);
    context.lineWidth = 1.6;
    const errors = off();
    frame.u.forEach((u, i) => {
      context.beginPath();
      context.arc((u + 0.5) * scale, (frame.v[i] + 0.5) * scale, 3.6, 0, 2 * Math.PI);
      context.strokeStyle = offColour(errors[i]);
      context.stroke();
    });
  }

  const told = () => {
    const known = off().filter((px) => px !== null).sort((a, b) => a - b);
    return known.length ? `${frame.u.length} tracks, ${known[known.length >> 1].toFixed(2)} px off in the median` : `${frame.u.length} tracks`;
  };
  const canvas = sharpCanvas({ role: "img", style: `aspect-ratio: ${width} / ${height}`,
    onpointermove: (event) => hintOfTrack(event, canvas, frame, off()), onpointerleave: hideHint,
    onclick: () => setCursor(one.id, frame.t_s) }, draw);
  const words = el("span", { class: "fine" });
  const show = () => {
    words.textContent = told();
    canvas.setAttribute("aria-label", `Left image at ${frame.t_s.toFixed(2)} s: ${words.textContent}`);
  };
  listen(show);
  show();
  return el("figure", { class: "card camera" }, canvas,
    el("figcaption", {}, el("b", { text: `${frame.t_s.toFixed(2)} s` }), words));
}

function offColour(px) {
  if (px === null || px === undefined) return "#ffffff";
  const place = Math.min(px / OFF_MOST_PX, 1) * (OFF_COLOURS.length - 1);
  const low = Math.min(Math.floor(place), OFF_COLOURS.length - 2);
  const part = (colour, i) => parseInt(colour.slice(1 + 2 * i, 3 + 2 * i), 16);
  const mixed = [0, 1, 2].map((i) => Math.round(part(OFF_COLOURS[low], i) * (low + 1 - place) + part(OFF_COLOURS[low + 1], i) * (place - low)));
  return `rgb(${mixed.join(", ")})`;
}

/** Tell the error of the track that the pointer is on. */
function hintOfTrack(event, canvas, frame, errors) {
  const scale = canvas.clientWidth / frame.size[0];
  const box = canvas.getBoundingClientRect();
  const [x, y] = [(event.clientX - box.left) / scale, (event.clientY - box.top) / scale];
  let nearest = -1;
  let least = 10 / scale;
  frame.u.forEach((u, i) => {
    const away = Math.hypot(u - x, frame.v[i] - y);
    if (away < least) [nearest, least] = [i, away];
  });
  if (nearest < 0) hideHint();
  else showHint([errors[nearest] === null || errors[nearest] === undefined ? "too few sightings" : `${errors[nearest].toFixed(2)} px off`], event.clientX, event.clientY);
}
