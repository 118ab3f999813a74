const SCENE_REACH = 0.5; // what strays widens a view by at most this share of the extent ...
const SCENE_LEAST_REACH_M = 30; // ... and landmarks by this much where the camera hardly moved

/** What the two views of a case share: tracks and landmarks in the truth's world, and the box that holds them. */
function sceneOf(one) {
  const tracks = one.rows.filter((row) => row.track !== null && row.track.t_s.length).map((row) => ({ row, ...row.track }));
  const scene = { case: one, tracks, truth: one.truth, maps: one.maps, map: defaultMap(one) };
  scene.box = boxOf(scene);
  return scene;
}

/** The map of the last run that ended well and has one. */
function defaultMap(one) {
  const good = one.maps.filter((map) => one.rows.some((row) => map.rows.includes(row.id) && row.status === "ok"));
  return good.length ? good[good.length - 1].estimator : "";
}

/**
 * The box that a view fits, [low, high] by axis: around the truth (without one, around the good tracks), widened by
 * tracks and landmarks, but only so far that none that strays makes all the others small.
 */
function boxOf(scene) {
  const good = scene.tracks.filter((track) => track.row.status === "ok");
  const core = scene.truth ? [scene.truth] : good.length ? good : scene.tracks;
  const axes = ["x", "y", "z"].map((axis) => rangeOf(core.map((track) => track[axis])) ?? [-1, 1]);
  const extent = Math.max(...axes.map(([low, high]) => high - low));
  const map = shownMap(scene);
  return axes.map((range, i) => {
    const axis = "xyz"[i];
    const tracks = rangeOf(good.map((track) => track[axis])) ?? range;
    const landmarks = map && map.x.length ? [quantile(map[axis], 0.02), quantile(map[axis], 0.98)] : range;
    const reach = SCENE_REACH * extent;
    return widened(widened(range, tracks, reach), landmarks, Math.max(reach, SCENE_LEAST_REACH_M));
  });
}

function widened([low, high], [least, most], reach) {
  return [Math.min(low, Math.max(least, low - reach)), Math.max(high, Math.min(most, high + reach))];
}

function shownTracks(scene) {
  return scene.tracks.filter((track) => isShown(track.row));
}

function shownMap(scene) {
  return scene.maps.find((map) => map.estimator === scene.map);
}

/** Earlier lines are wider, so that equal ones show as a border. */
function trackWidth(scene, track) {
  const place = scene.tracks.indexOf(track) / Math.max(scene.tracks.length - 1, 1);
  return 2.8 - 1.4 * place;
}

/** Draw everything through ``at(x, y, z)``, which gives a point on the canvas or null behind the eye. */
function drawScene(context, scene, at) {
  const map = shownMap(scene);
  if (map) {
    context.fillStyle = ink("--landmark");
    for (let i = 0; i < map.x.length; i++) {
      const point = at(map.x[i], map.y[i], map.z[i]);
      if (point !== null) context.fillRect(point[0] - 1, point[1] - 1, 2, 2);
    }
  }
  const line = (track) => strokeLine(context, track.x.length, (i) =>
    track.x[i] === null ? null : at(track.x[i], track.y[i], track.z[i]));
  if (scene.truth) {
    context.strokeStyle = ink("--truth");
    context.lineWidth = 4.5;
    context.setLineDash([]);
    context.globalAlpha = 0.75;
    line(scene.truth);
    context.globalAlpha = 1;
  }
  for (const track of shownTracks(scene)) {
    lineStyle(context, track.row, trackWidth(scene, track));
    line(track);
    context.globalAlpha = 1;
  }
  drawCursor(context, scene, at);
}

/** Where everybody was at the time of the cursor; at the start of the tracks while there is none. */
function drawCursor(context, scene, at) {
  const t = state.cursor.get(scene.case.id) ?? -Infinity;
  const everyone = [...(scene.truth ? [[scene.truth, "--truth"]] : []),
    ...shownTracks(scene).map((track) => [track, lookOf(track.row).colour])];
  for (const [track, colour] of everyone) {
    if (!track.t_s.length) continue;
    const i = nearestIndex(track.t_s, t);
    const point = track.x[i] === null ? null : at(track.x[i], track.y[i], track.z[i]);
    if (point !== null) dot(context, point, colour === "--truth" ? 6 : 5, ink(colour));
  }
}

/** Find the point of a shown track nearest to a place on the canvas: { track or null for the truth, t }, or null. */
function pickTrack(scene, at, x, y) {
  let found = null;
  let least = 22;
  const everyone = [...shownTracks(scene), ...(scene.truth ? [{ row: null, ...scene.truth }] : [])];
  for (const track of everyone) {
    for (let i = 0; i < track.x.length; i++) {
      const point = track.x[i] === null ? null : at(track.x[i], track.y[i], track.z[i]);
      if (point === null) continue;
      const distance = Math.hypot(point[0] - x, point[1] - y);
      if (distance < least) {
        least = distance;
        found = { row: track.row, t: track.t_s[i], place: [track.x[i], track.y[i], track.z[i]] };
      }
    }
  }
  return found;
}

/** Move the case's cursor to what is pointed at, and say what it is. */
function hoverScene(scene, at, x, y, event) {
  const found = pickTrack(scene, at, x, y);
  if (found === null) {
    hideHint();
    return;
  }
  setCursor(scene.case.id, found.t);
  const error = found.row ? errorAt(found.row, found.t) : null;
  const place = found.place.map((value) => value.toFixed(1).replace("-", MINUS)).join(", ");
  showHint([
    found.row ? hintLine(found.row, error === null ? "" : `${shortText(error)} m ${scene.case.error.what}`) : "truth",
    `${found.t.toFixed(2)} s, at (${place}) m`,
  ], event.clientX, event.clientY);
}

function errorAt(row, t) {
  if (!row.errors || !row.errors.t_s.length) return null;
  return row.errors.position_m[nearestIndex(row.errors.t_s, t)];
}

/** Return a round number of metres that is about a given length: 1, 2 or 5 times a power of ten. */
function roundLength(length) {
  const power = 10 ** Math.floor(Math.log10(length));
  return power * [5, 2, 1].find((factor) => factor * power <= length);
}
