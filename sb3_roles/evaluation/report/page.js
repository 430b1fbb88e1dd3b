// What all parts share, and the head of the page. Text from the data becomes text nodes, never markup.
const DATA = JSON.parse(document.getElementById("data").textContent);
const SVG = "http://www.w3.org/2000/svg";
const byId = (id) => document.getElementById(id);

/** Make an element: attributes by name, "on..." as listeners, children as nodes or texts. */
function make(tag, attributes = {}, ...children) {
  const svg = tag.startsWith("svg:");
  const node = svg ? document.createElementNS(SVG, tag.slice(4)) : document.createElement(tag);
  for (const [name, value] of Object.entries(attributes)) {
    if (value === null || value === undefined || value === false) continue;
    if (name.startsWith("on")) node.addEventListener(name.slice(2), value);
    else node.setAttribute(name, value === true ? "" : value);
  }
  node.append(...children.flat().filter((child) => child !== null && child !== undefined && child !== false));
  return node;
}

/** A number stays on the line of its percent sign. */
const whole = (text) => text.replace(/(\d) %/g, "$1\u00a0%");
const fixed = (value, digits = 1) => value.toFixed(digits).replace("-", "\u2212");
const signed = (value) => (Math.abs(value) < 0.05 ? "0.0" : (value > 0 ? "+" : "") + fixed(value));
const digitsOf = (value, unit) => (unit === "steps" && Number.isInteger(value) ? 0 : 1);
const robots = (n) => (n === 1 ? "1 robot" : `${n} robots`);

function duration(seconds) {
  if (seconds < 1e-3) return `${Number((seconds * 1e6).toPrecision(3))} \u00b5s`;
  if (seconds < 1) return `${Number((seconds * 1e3).toPrecision(3))} ms`;
  return `${Number(seconds.toPrecision(3))} s`;
}

const metricName = (metric) => (DATA.metrics[metric] ? DATA.metrics[metric].short : metric);

/** A row of radio buttons. */
function radios(parent, name, choices, chosen, onChoice) {
  for (const [value, label] of choices) {
    const input = make("input", { type: "radio", name, value, checked: value === chosen });
    input.addEventListener("change", () => onChoice(value));
    parent.append(make("label", {}, input, make("span", {}, label)));
  }
}

const MARKS = { agrees: ["\u2713", "Agrees"], partly: ["\u25d0", "In part"], differs: ["\u2260", "Differs"],
    note: ["\u2022", "Note"] };

function drawHead() {
  byId("quick").hidden = !DATA.quick;
  for (const { mark, head, text } of DATA.summary) {
    const [sign, name] = MARKS[mark];
    byId("points").append(
      make("li", { class: `point ${mark}` },
        make("span", { class: "mark", role: "img", "aria-label": name, title: name }, sign),
        make("div", {}, make("strong", {}, whole(head)), make("p", {}, whole(text)))));
  }
  if (!DATA.summary.length) byId("points").append(make("li", { class: "point note" }, "Nothing was played."));
  for (const { name, value } of DATA.facts) {
    const parts = Array.isArray(value) ? value : [value];
    byId("facts").append(make("dt", {}, name), make("dd", {}, parts.map((part) => make("div", {}, part))));
  }
  for (const { caption, source } of DATA.figures) {
    byId("figure-list").append(
      make("figure", {},
        make("div", { class: "scroll", tabindex: "0", role: "group", "aria-label": caption },
          make("img", { src: source, alt: caption })),
        make("figcaption", {}, caption)));
  }
  if (!DATA.figures.length) byId("figure-list").append(make("p", { class: "hint" }, "No figures were made."));
}

drawHead();
