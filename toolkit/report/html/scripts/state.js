/**
 * What the reader has chosen: which lines are hidden, which one is pointed at, where the cursor of each case is.
 * Every view listens, and draws again in the next frame of the screen.
 */
const state = {
  hidden: new Set(), // keys of lines, the same in every case
  pointed: null, // the key of the line that is pointed at
  over: "path", // errors over "path" or "time"
  cursor: new Map(), // case id -> seconds from its first frame
  zoom: new Map(), // case id -> [from, to] in seconds, absent where all is shown
};

const listeners = new Set();
let asked = false;

function listen(listener) {
  listeners.add(listener);
}

function changed() {
  if (asked) return;
  asked = true;
  requestAnimationFrame(() => {
    asked = false;
    for (const listener of listeners) listener();
  });
}

/** A line is one estimator and kind of output, in whatever case it appears. */
function keyOf(row) {
  return `${row.estimator} ${row.output}`;
}

function labelOf(row) {
  return row.output === "both" ? row.estimator : `${row.estimator} ${row.output}`;
}

function isShown(row) {
  return !state.hidden.has(keyOf(row));
}

function toggleLine(key, keys, only) {
  if (only) {
    const alone = keys.every((other) => (other === key) !== state.hidden.has(other));
    state.hidden = new Set(alone ? [] : keys.filter((other) => other !== key));
  } else if (state.hidden.has(key)) state.hidden.delete(key);
  else state.hidden.add(key);
  changed();
}

function pointAt(key) {
  if (state.pointed === key) return;
  state.pointed = key;
  changed();
}

function setCursor(caseId, t) {
  if (state.cursor.get(caseId) === t) return;
  state.cursor.set(caseId, t);
  changed();
}

function setZoom(caseId, range) {
  if (range === null) state.zoom.delete(caseId);
  else state.zoom.set(caseId, range);
  changed();
}

const COLOURS = 7;
const DASHES = { causal: [[7, 4], [2, 4], [1, 6], [4, 2, 2, 2]], final: [[], [9, 2, 2, 2], [14, 3], [11, 2, 4, 2]] };

/** Return how a row's line is drawn, as in the figures: its colour, dashed where it knew the past only; past the last colour otherwise. */
function lookOf(row) {
  const styles = DASHES[row.output === "causal" ? "causal" : "final"];
  return { colour: `--line-${row.colour % COLOURS}`, dash: styles[Math.floor(row.colour / COLOURS) % styles.length] };
}
