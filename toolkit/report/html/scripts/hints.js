/** One small note beside what the reader points at; it never takes the focus. */
const hint = el("div", { class: "hint", role: "tooltip", hidden: true });

function showHint(lines, clientX, clientY) {
  hint.replaceChildren(...lines.map((line) => (line instanceof Node ? line : el("div", { text: line }))));
  hint.hidden = false;
  const { width, height } = hint.getBoundingClientRect();
  const room = document.documentElement;
  const right = clientX + 16 + width < room.clientWidth;
  const left = right ? clientX + 16 : Math.max(8, clientX - 16 - width);
  const top = clientY + 16 + height < room.clientHeight ? clientY + 16 : Math.max(8, clientY - 12 - height);
  hint.style.transform = `translate(${Math.min(left, room.clientWidth - width - 8)}px, ${top}px)`;
}

function hideHint() {
  hint.hidden = true;
}

/** Show a text beside an element while the pointer is on it, or after a tap. */
function hintOn(node, text) {
  const show = (event) => showHint([text], event.clientX, event.clientY);
  node.addEventListener("pointerenter", show);
  node.addEventListener("pointerdown", show);
  node.addEventListener("pointerleave", hideHint);
}

/** A line of a hint: a swatch of the row's line, its name and a value. */
function hintLine(row, value) {
  return el("div", { class: "hint-line" }, swatch(row), el("span", { text: labelOf(row) }), el("b", { text: value }));
}

/** Return a small picture of a row's line; what it means stands in words beside it. */
function swatch(row) {
  const look = lookOf(row);
  const names = "http://www.w3.org/2000/svg";
  const svg = document.createElementNS(names, "svg");
  const line = document.createElementNS(names, "line");
  for (const [name, value] of Object.entries({ class: "swatch", viewBox: "0 0 26 8", "aria-hidden": "true" }))
    svg.setAttribute(name, value);
  for (const [name, value] of Object.entries({ x1: 1, x2: 25, y1: 4, y2: 4, "stroke-dasharray": look.dash.join(" ") }))
    line.setAttribute(name, value);
  line.style.stroke = `var(${look.colour})`;
  svg.append(line);
  return svg;
}

window.addEventListener("scroll", hideHint, { passive: true });
window.addEventListener("keydown", (event) => {
  if (event.key === "Escape") hideHint();
});
