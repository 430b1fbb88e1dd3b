// Where ours and the printed numbers lie, what the metrics mean, and the list of differences.

/** Every printed number as a dot: a line per row of the tables, ours minus the paper's along it. */
function drawStrip() {
  const cells = DATA.printed.filter((cell) => cell.ours !== null && cell.metric !== "time_e_paper");
  const names = new Set(DATA.tables.flatMap((table) => table.rows.map((row) => row.name)));
  const rows = [...names].filter((name) => cells.some((cell) => cell.row === name));
  if (!rows.length) return;
  const width = 460, left = 166, right = 14, line = 30, top = 26;
  const height = top + line * rows.length + 26;
  const differences = cells.map((cell) => cell.difference || 0);
  const low = Math.min(-10, 10 * Math.floor(Math.min(...differences) / 10));
  const high = Math.max(10, 10 * Math.ceil(Math.max(...differences) / 10));
  const x = (value) => left + ((value - low) / (high - low)) * (width - left - right);
  const svg = make("svg:svg", { viewBox: `0 0 ${width} ${height}`, role: "img",
      "aria-label": "Ours minus the printed numbers, in points, by row" });
  const step = high - low > 60 ? 20 : 10;
  for (let value = Math.ceil(low / step) * step; value <= high; value += step) {
    svg.append(make("svg:line", { class: value ? "tick" : "zero", x1: x(value), x2: x(value), y1: top - 8,
        y2: height - 22 }),
      make("svg:text", { class: "label", x: x(value), y: height - 8, "text-anchor": "middle" },
          value ? signed(value).replace(".0", "") : "0"));
  }
  rows.forEach((name, k) => {
    const y = top + line * (k + 0.5);
    svg.append(make("svg:text", { class: "name", x: left - 12, y: y + 4, "text-anchor": "end" },
        shorten(DATA.rows[name].label, 24)));
    for (const cell of cells.filter((one) => one.row === name)) {
      const cover = cell.metric === "cover";
      const at = x(cell.difference || 0);
      const what = `${cell.label}, ${cell.scene}, ${robots(cell.n_agents)}, ${metricName(cell.metric)}: `
        + `ours ${fixed(cell.ours)}, printed ${cell.paper}`;
      const dot = cover ? make("svg:rect", { class: "dot cover", x: at - 3.4, y: y + 2, width: 6.8,
          height: 6.8 })
        : make("svg:circle", { class: "dot explore", cx: at, cy: y - 5, r: 3.6 });
      dot.append(make("svg:title", {}, what));
      svg.append(dot);
    }
  });
  svg.append(make("svg:circle", { class: "dot explore", cx: left + 6, cy: 8, r: 3.6 }),
      make("svg:text", { class: "label", x: left + 14, y: 12 }, "explored (paper)"),
    make("svg:rect", { class: "dot cover", x: left + 118, y: 4.6, width: 6.8, height: 6.8 }),
        make("svg:text", { class: "label", x: left + 130, y: 12 }, "covered"));
  byId("strip").append(svg,
      make("figcaption", {},
      "Ours minus the printed number, in points; one mark for each place. Right of the line: ours is "
      + "higher. A printed 100 counts as reached from 100 on."));
}

const shorten = (text, length) => (text.length > length ? `${text.slice(0, length - 1)}\u2026` : text);

function drawHonesty() {
  const body = byId("honesty-body");
  body.append(make("h3", {}, "What the metrics mean"),
    make("dl", { class: "meanings" }, Object.entries(DATA.metrics).flatMap(
        ([name, { text }]) => [make("dt", {}, make("code", {}, name)),
          make("dd", {}, whole(`${text[0].toUpperCase()}${text.slice(1)}.`))])));
  body.append(make("h3", {}, "Setting and method"),
    make("p", { class: "hint" },
        "What our side rests on: the paper\u2019s text, the authors\u2019 released code, a measurement by "
        + "simulation, an inference from the printed numbers, or a choice of ours."));
  const counts = new Map();
  for (const { source } of DATA.deviations) counts.set(source, (counts.get(source) || 0) + 1);
  const filter = make("fieldset", { class: "choice" }, make("legend", {}, "Show"));
  const list = make("div", { id: "deviations" });
  const choices = [["all", `all (${DATA.deviations.length})`],
      ...[...counts].map(([source, n]) => [source, `${source} (${n})`])];
  radios(filter, "source", choices, "all", (chosen) => listDeviations(list, chosen));
  body.append(filter, list);
  listDeviations(list, "all");
  drawPrinted(body);
}

function listDeviations(list, chosen) {
  const kept = DATA.deviations.filter(({ source }) => chosen === "all" || source === chosen);
  const areas = [...new Set(kept.map(({ area }) => area))];
  list.replaceChildren(...areas.map((area) => make("section", { class: "area" }, make("h4", {}, area),
    kept.filter((one) => one.area === area).map((one) => make("div", { class: "deviation" },
      make("h5", {}, one.what, make("span", { class: `badge source ${one.source.replace(" ", "-")}` },
          one.source)),
      make("div", { class: "sides" },
        make("p", {}, make("b", {}, "Paper"), whole(one.paper)),
        make("p", {}, make("b", {}, "Here"), whole(one.ours))),
      one.switch ? make("p", { class: "switch" }, make("b", {}, "To switch"), one.switch) : null)))));
}

/** All printed numbers with ours, the largest difference first. */
function drawPrinted(body) {
  const cells = DATA.printed;
  const played = cells.filter((cell) => cell.played);
  const missed = played.filter((cell) => !cell.reached);
  body.append(make("h3", {}, "What was not reproduced, and by how much"));
  if (!cells.length) {
    body.append(make("p", { class: "hint" }, "The tables hold no printed numbers."));
    return;
  }
  body.append(make("p", { class: "hint" },
    `${cells.length} numbers are printed; ${played.length} of them were played, and ours falls short of `
    + `${missed.length}. The largest difference comes first, in either direction, and before it `
    + "what is never reached, a dash; a printed 100 is reached from 100 on."));
  const names = [...new Set(cells.map((cell) => cell.row))];
  const chosen = make("select", { id: "printed-row" }, make("option", { value: "" }, "all methods"),
      names.map((name) => make("option", { value: name }, DATA.rows[name].label)));
  const only = make("input", { type: "checkbox", id: "printed-short" });
  const rows = make("tbody", {});
  const fill = () => rows.replaceChildren(...cells
    .filter((cell) => (!chosen.value || cell.row === chosen.value)
        && (!only.checked || (cell.played && !cell.reached)))
    .map((cell) => make("tr", {},
      make("td", {}, cell.label), make("td", {}, `${cell.scene}, ${cell.n_agents}`),
          make("td", {}, metricName(cell.metric)), make("td", { class: "number" },
          fixed(cell.paper, cell.metric === "time_e_paper" ? 0 : 1)),
      make("td", { class: "number" }, !cell.played ? "\u00b7" : cell.ours === null ? "\u2013"
          : fixed(cell.ours)),
      make("td", { class: `number ${cell.reached ? "reached" : "behind"}` },
          !cell.played ? "\u00b7" : cell.ours === null ? "\u2013" : cell.difference === null ? "\u2713" : signed(cell.difference)),
      make("td", {}, cell.table))));
  chosen.addEventListener("change", fill);
  only.addEventListener("change", fill);
  fill();
  const head = ["Method", "Scene, robots", "Metric", "Printed", "Ours", "Difference", "Table"];
  const isNumber = (name) => ["Printed", "Ours", "Difference"].includes(name);
  body.append(make("div", { class: "controls" }, make("label", {}, "Method ", chosen),
      make("label", { class: "check" }, only, make("span", {}, "only where ours falls short"))),
    make("div", { class: "scroll tall", tabindex: "0", role: "group",
        "aria-label": "Printed numbers and ours" },
      make("table", { class: "plain", id: "printed" },
          make("thead", {}, make("tr", {}, head.map((name) => make("th",
          { scope: "col", class: isNumber(name) ? "number" : null }, name)))), rows)));
}
