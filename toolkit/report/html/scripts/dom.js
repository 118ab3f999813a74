/** Make an element. Properties that start with "on" are listeners, "text" is its text, all others are attributes. */
function el(tag, properties = {}, ...children) {
  const node = document.createElement(tag);
  for (const [name, value] of Object.entries(properties)) {
    if (value === null || value === undefined || value === false) continue;
    if (name === "text") node.textContent = value;
    else if (name.startsWith("on")) node.addEventListener(name.slice(2), value);
    else node.setAttribute(name, value === true ? "" : String(value));
  }
  node.append(...children.flat(Infinity).filter((child) => child !== null && child !== undefined));
  return node;
}

/** Make a drop-down with a label; options are [value, text]. */
function dropdown(label, options, value, onChange) {
  const select = el("select", { onchange: () => onChange(select.value) });
  for (const [key, text] of options) select.append(el("option", { value: key, text, selected: key === value }));
  return el("label", { class: "choice" }, el("span", { text: label }), select);
}

/** Make a row of buttons of which the one of the present value is pressed; options are [value, text]. */
function segmented(label, options, present, onChange) {
  const buttons = options.map(([key, text]) => el("button", { type: "button", text, onclick: () => onChange(key) }));
  const mark = () => buttons.forEach((button, i) => button.setAttribute("aria-pressed", String(options[i][0] === present())));
  listen(mark);
  mark();
  return el("div", { class: "segmented", role: "group", "aria-label": label }, buttons);
}

/** Tell those who cannot see the page what has changed on it. */
function announce(text) {
  document.getElementById("announcer").textContent = text;
}
