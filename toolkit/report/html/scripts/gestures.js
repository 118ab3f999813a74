/**
 * Drag, pinch, wheel and keys on a view. One finger that moves up or down scrolls the page as ever; the wheel zooms
 * only with Ctrl or once the view has the focus. ``on`` has drag(dx, dy, event), zoom(factor, x, y), hover(x, y, event),
 * leave() and keys: a mapping of key to action.
 */
function addGestures(canvas, on) {
  const fingers = new Map();
  const place = (event) => {
    const box = canvas.getBoundingClientRect();
    return [event.clientX - box.left, event.clientY - box.top];
  };

  canvas.addEventListener("pointerdown", (event) => {
    canvas.setPointerCapture(event.pointerId);
    fingers.set(event.pointerId, place(event));
    if (fingers.size === 1) on.hover(...place(event), event);
  });
  canvas.addEventListener("pointermove", (event) => {
    const now = place(event);
    const before = fingers.get(event.pointerId);
    if (before === undefined) {
      on.hover(...now, event);
      return;
    }
    if (fingers.size === 2) pinch(event.pointerId, before, now, event);
    else on.drag(now[0] - before[0], now[1] - before[1], event);
    fingers.set(event.pointerId, now);
  });
  function pinch(id, before, now, event) {
    const other = [...fingers].find(([key]) => key !== id)[1];
    const spread = (p) => Math.max(Math.hypot(p[0] - other[0], p[1] - other[1]), 1);
    on.zoom(spread(now) / spread(before), (now[0] + other[0]) / 2, (now[1] + other[1]) / 2);
    on.drag((now[0] - before[0]) / 2, (now[1] - before[1]) / 2, event, true);
  }
  for (const name of ["pointerup", "pointercancel"])
    canvas.addEventListener(name, (event) => fingers.delete(event.pointerId));
  canvas.addEventListener("pointerleave", () => on.leave());
  // Two fingers are for the view, whatever the browser would do with them.
  canvas.addEventListener("touchmove", (event) => event.touches.length > 1 && event.preventDefault(), { passive: false });
  canvas.addEventListener("wheel", (event) => {
    if (!event.ctrlKey && document.activeElement !== canvas) return;
    event.preventDefault();
    on.zoom(Math.exp(-event.deltaY * (event.ctrlKey ? 0.01 : 0.0015)), ...place(event));
  }, { passive: false });
  canvas.addEventListener("keydown", (event) => {
    const action = on.keys[event.key];
    if (action === undefined || event.ctrlKey || event.metaKey || event.altKey) return;
    event.preventDefault();
    action(event);
  });
}

/** The buttons beside a view, for those who neither drag nor type. */
function viewButtons(buttons) {
  return el("div", { class: "view-buttons" }, buttons.map(([text, label, action]) =>
    el("button", { type: "button", text, "aria-label": label, title: label, onclick: action })));
}

/** A card that can fill the window. */
function expandable(card, canvas, what) {
  const button = el("button", { type: "button", class: "quiet", "aria-pressed": "false", text: "Expand",
    "aria-label": `Expand ${what}`, onclick: () => expand(!card.classList.contains("expanded")) });
  function expand(large) {
    card.classList.toggle("expanded", large);
    document.body.classList.toggle("has-expanded", large);
    button.setAttribute("aria-pressed", String(large));
    button.textContent = large ? "Close" : "Expand";
    if (large) canvas.focus();
    changed();
  }
  card.addEventListener("keydown", (event) => {
    if (event.key === "Escape" && card.classList.contains("expanded")) {
      expand(false);
      button.focus();
    }
  });
  return button;
}
