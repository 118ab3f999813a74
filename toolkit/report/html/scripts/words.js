const OUTPUT_MEANING = "causal: what was estimated at each frame; final: what was estimated from the whole recording; both: the two are the same";
const MARKS_MEANING = "overconfident, timid: errors (NEES), or without truth innovations (NIS), larger or smaller than the stated uncertainty allows; heavy-tailed: innovations that are small behind a gate that rejected many; contradicted: corrections by the tracks that have one direction, by more than the stated uncertainty allows; the notes have the figures";
const TABLE_NOTE = "The best of each recording is set off; point at a dash, or read the notes below, for why a value is missing. Compare causal with causal and final with final.";

/** Return what a status means, and what a mark beside it does. */
function statusMeaning() {
  return `${Object.entries(payload.statuses).map((one) => one.join(": ")).join("; ")}. ${MARKS_MEANING}`;
}

/** What the case says in words: trouble first, then notes, the audit, the recording, how to repeat it. */
function wordsOf(one) {
  const { notes, remarks = [], audit, undecided = {}, facts = [], start } = one.words;
  return [
    el("div", { class: "words" },
      listCard("Notes", notes, "Nothing out of the ordinary."),
      audit ? auditCard(audit, undecided) : listCard("Is the stated uncertainty consistent?", one.words.verdicts),
      listCard("The recording", [`Every estimator started from: ${start}`, ...facts]),
      one.card?.length ? listCard("Its tracks", one.card) : null,
      manifestCard(one)),
    remarks.length ? folded("Remarks on single numbers", el("ul", {}, remarks.map((text) => el("li", { text })))) : null,
    logsOf(one),
    folded("Meaning of every column", meanings()),
  ];
}

function listCard(title, lines, none = "") {
  const body = lines.length ? el("ul", {}, lines.map((text) => el("li", { text }))) : el("p", { text: none });
  return el("section", { class: "card" }, el("h3", { text: title }), body);
}

/** The faults that were found, then those that could not be judged, together where the reason is the same. */
function auditCard(findings, undecided) {
  const list = findings.map((found) => el("li", {},
    el("span", { class: `outcome ${found.outcome.replaceAll(" ", "-")}`, text: found.outcome }), " ",
    el("b", { text: found.fault }), `: ${found.detail}`));
  const unjudged = [...new Set(Object.values(undecided))].map((why) => el("li", {},
    el("span", { class: "outcome", text: "not decidable" }), " ",
    el("b", { text: Object.keys(undecided).filter((fault) => undecided[fault] === why).join(", ") }), `: ${why}`));
  return el("section", { class: "card" }, el("h3", { text: "What the audit found" }),
    list.length ? null : el("p", { text: "No fault found in the recording." }),
    list.length || unjudged.length ? el("ul", { class: "findings" }, list, unjudged) : null);
}

function folded(title, ...content) {
  return el("details", { class: "card" }, el("summary", { text: title }), content);
}

function logsOf(one) {
  const logs = new Map(one.rows.filter((row) => row.log && row.log.length).map((row) => [row.estimator, row.log]));
  if (!logs.size) return null;
  return folded("Log of the estimators", [...logs].map(([name, lines]) =>
    el("div", {}, el("h4", { text: name }), el("pre", { text: lines.join("\n") }))));
}

function meanings() {
  return el("dl", { class: "meanings" }, payload.columns.filter((column) => column.meaning).map((column) =>
    [el("dt", { text: column.name }), el("dd", { text: column.meaning })]));
}

function manifestCard(one) {
  const { command, date, versions, sequence, cpu, os, git_revision: revision, threads, seeds } = one.manifest;
  const facts = [
    ["date", date], ["data", `${sequence.name}, SHA-256 ${sequence.hash}`],
    ["versions", Object.entries(versions).filter(([, v]) => v).map(([name, v]) => `${name} ${v}`).join(", ")],
    ["revision", revision ?? "not from a checkout"], ["machine", `${cpu}; ${os}; ${threads?.cpus ?? "?"} CPU(s)`],
    ["seeds", Object.entries(seeds).map(([name, n]) => `${name} ${n}`).join(", ")],
  ];
  const code = el("code", { text: command || "not recorded", tabindex: "0" });
  const copy = el("button", { type: "button", class: "quiet", text: "Copy", "aria-label": "Copy the command", onclick: () => copyText(command, copy) });
  return el("section", { class: "card" }, el("h3", { text: "How to repeat it" }),
    el("div", { class: "command" }, code, command ? copy : null),
    el("dl", { class: "facts" }, facts.map(([name, value]) => [el("dt", { text: name }), el("dd", { text: value })])),
    el("details", {}, el("summary", { text: "The whole manifest" }), el("pre", { text: JSON.stringify(one.manifest, null, 2) })));
}

/** Copy a text where the browser allows it; from disk, some only do so by way of a selection. */
async function copyText(text, button) {
  try {
    await navigator.clipboard.writeText(text);
  } catch {
    const field = el("textarea", { text });
    document.body.append(field);
    field.select();
    document.execCommand("copy");
    field.remove();
    button.focus();
  }
  button.textContent = "Copied";
  setTimeout(() => (button.textContent = "Copy"), 1500);
}
