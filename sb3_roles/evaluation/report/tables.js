// Tables I to V: sorting, the choice of metrics, and what a cell says when it is pointed at.
const PAPER_ONLY = ["explo_paper", "time_e_paper"];
const TRUE_ONLY = ["explo_true", "t90_true"];
let shownMetrics = "paper";

const isShown = (metric) =>
  shownMetrics === "both" || !(shownMetrics === "paper" ? TRUE_ONLY : PAPER_ONLY).includes(metric);

/** Text lines of the tooltip of a cell. */
function explain(row, place, metric, value, seconds) {
  const lines = [`${row.label}, ${place}`, DATA.metrics[metric] ? DATA.metrics[metric].label : metric];
  if (!value || !value.played) lines.push("not played yet");
  else if (value.mean === null) lines.push("never reached");
  else {
    const unit = value.unit === "%" ? " %" : " steps";
    const digits = digitsOf(value.mean, value.unit);
    lines.push(`mean ${fixed(value.mean, digits)}${unit}`);
    if (value.low !== null) {
      lines.push(`95 % interval ${fixed(value.low, digits)} to ${fixed(value.high, digits)}`);
    }
    if (value.share !== null) lines.push(`reached in ${fixed(100 * value.share, 0)} % of the episodes`);
  }
  if (value && value.printed) {
    lines.push(value.paper === null ? "the paper prints a dash"
        : `the paper prints ${value.paper}${value.capped ? ", which stands for 100 or more" : ""}`);
  }
  if (value && value.played) {
    const runs = value.seeds > 1 ? `, each by ${value.seeds} training seeds` : value.seeds === 1
        ? ", one training seed" : "";
    lines.push(`${value.episodes} episodes${runs}`);
  }
  if (row.budget) lines.push(row.budget);
  if (row.drawn) lines.push("actions are drawn, not the likeliest ones");
  if (seconds !== null) lines.push(`${duration(seconds)} to decide on a step`,
      row.batch > 1 ? `(a team\u2019s share, up to ${row.batch} teams at once)` : "(one team at a time)");
  return lines;
}

const tip = byId("tip");

let pointedAt = null;

function showTip(target, lines) {
  hideTip();
  pointedAt = target;
  tip.replaceChildren(...lines.map((line, k) => make(k ? "div" : "strong", {}, line)));
  tip.hidden = false;
  target.setAttribute("aria-describedby", "tip");
  placeTip();
}

function placeTip() {
  if (!pointedAt) return;
  const box = pointedAt.getBoundingClientRect();
  const own = tip.getBoundingClientRect();
  const left = Math.max(6, Math.min(box.left + box.width / 2 - own.width / 2, innerWidth - own.width - 6));
  const below = box.bottom + own.height + 10 < innerHeight;
  tip.style.left = `${left}px`;
  tip.style.top = `${below ? box.bottom + 6 : Math.max(6, box.top - own.height - 6)}px`;
}

function hideTip() {
  if (pointedAt) pointedAt.removeAttribute("aria-describedby");
  pointedAt = null;
  tip.hidden = true;
}

addEventListener("scroll", placeTip, { passive: true, capture: true });
addEventListener("keydown", (event) => { if (event.key === "Escape") hideTip(); });

/** The two lines of a cell. */
function cellContent(value) {
  if (!value) return [make("span", { class: "absent" }, "\u00b7")];
  const lines = [];
  if (!value.played) lines.push(make("span", { class: "absent" }, "\u00b7"));
  else if (value.mean === null) lines.push(make("span", { class: "mean" }, "\u2013"));
  else {
    const digits = digitsOf(value.mean, value.unit);
    lines.push(make("span", { class: "mean" }, fixed(value.mean, digits)));
    if (value.low !== null) lines.push(" ", make("span", { class: "within" },
        `\u00b1${fixed((value.high - value.low) / 2, value.unit === "steps" ? digits : 1)}`));
    if (value.share !== null) lines.push(" ", make("span", { class: "within" },
        `(${fixed(100 * value.share, 0)}\u00a0%)`));
  }
  if (!value.printed) return lines;
  const printed = value.paper === null ? "\u2013" : value.capped ? "\u2265100"
      : fixed(value.paper, digitsOf(value.paper, value.unit));
  const second = make("span", { class: "print" }, printed);
  if (value.played && value.mean !== null && value.paper !== null) {
    const difference = value.difference === null ? "\u2713" : signed(value.difference);
    second.append(make("span", { class: value.reached ? "reached" : "behind" }, difference));
  }
  return [...lines, second];
}

const HELP = { order: "In the order of the plan",
    decision: "Median time to decide on a step, a team\u2019s share of its batch; the median of the scenes" };

class ResultTable {
  constructor(data) {
    this.data = data;
    this.entries = data.teams.flatMap((n, team) => data.rows.map((row) => ({ row, n, team })));
    this.withOverall = data.rows.some((row) => row.overall.some((values) => values.some(Boolean)));
    this.sort = null; // {key, descending}
    this.focus = [0, 0];
    this.box = make("div", { class: "scroll", role: "group", "aria-label": data.caption });
    this.node = make("article", { class: "table", id: `table-${data.name}` }, make("h3", {}, data.caption),
        this.box,
      make("details", { class: "notes" }, make("summary", {}, "Notes"),
          make("ul", {}, data.notes.map((note) => make("li", {}, note)))));
    this.draw();
  }

  /** Columns with numbers: how they are called, and how to get the value of a row. */
  columns() {
    const metrics = this.data.metrics.map((metric, m) => ({ metric,
        m })).filter(({ metric }) => isShown(metric));
    const columns = this.data.scenes.flatMap((scene, s) => metrics.map(({ metric, m }, k) => ({
      key: `${scene.name}:${metric}`, metric, group: k ? null : scene.label, span: metrics.length, scene,
      value: ({ row, team }) => row.values[team][s][m], seconds: ({ row, team }) => row.seconds[team][s] })));
    if (!this.withOverall) return columns;
    const hasOverall = ({ m }) => this.data.rows.some((row) => row.overall.some((values) => values[m]));
    const over = metrics.filter(hasOverall);
    return columns.concat(over.map(({ metric, m }, k) => ({
      key: `all:${metric}`, metric, group: k ? null : `Mean of ${this.data.scenes.length}`, span: over.length, scene: null,
      value: ({ row, team }) => row.overall[team][m], seconds: () => null })));
  }

  draw() {
    hideTip();
    const columns = this.columns();
    const teams = this.data.teams.length > 1;
    const top = make("tr", {}, this.header("Method", "order", "ascending", { rowspan: 2, class: "name" }));
    if (teams) top.append(this.header("Robots", "robots", "ascending", { rowspan: 2 }));
    const second = make("tr", {});
    for (const column of columns) {
      if (column.group) top.append(make("th", { scope: "colgroup", colspan: column.span, class: "group" },
          column.group));
      second.append(this.header(metricName(column.metric), column.key,
        /^time|^t90/.test(column.metric) ? "ascending" : "descending",
            { class: column.group ? "first" : null }));
    }
    top.append(this.header("Decision", "decision", "ascending", { rowspan: 2, class: "first" }));
    const body = this.sorted(columns).map((entry, k) => this.rowOf(entry, columns, teams, k));
    const table = make("table", { role: "grid" }, make("thead", {}, top, second), make("tbody", {}, body));
    this.box.replaceChildren(table);
    this.cells = body.map((tr) => [...tr.querySelectorAll("td")]);
    this.focus = [0, 0];
    if (this.cells.length) this.cells[0][0].tabIndex = 0;
    table.addEventListener("keydown", (event) => this.onKey(event));
  }

  header(label, key, first, attributes) {
    const active = (this.sort || { key: "order" }).key === key;
    const descending = this.sort ? this.sort.descending : false;
    const button = make("button", { type: "button", title: HELP[key] || null }, label,
        make("span", { class: "arrow", "aria-hidden": "true" },
        active ? (descending ? "\u2193" : "\u2191") : ""));
    button.addEventListener("click", () => {
      this.sort = { key, descending: active && this.sort ? !descending : first === "descending" };
      if (key === "order") this.sort = null;
      this.draw();
      this.box.querySelector(`[data-key="${CSS.escape(key)}"] button`).focus();
    });
    return make("th", { scope: "col", "data-key": key,
        "aria-sort": active ? (descending ? "descending" : "ascending") : "none", ...attributes }, button);
  }

  sorted(columns) {
    if (!this.sort) return this.entries;
    const { key, descending } = this.sort;
    const column = columns.find((one) => one.key === key);
    const number = (entry) => {
      if (key === "robots") return entry.n;
      if (key === "decision") return this.decision(entry);
      const value = column && column.value(entry);
      return value && value.played ? value.mean : null;
    };
    // Bounds are no rivals: they stay last. So does, before them, what has no number.
    const rank = (entry) => (entry.row.bound ? 2 : number(entry) === null ? 1 : 0);
    return [...this.entries].sort((a, b) => rank(a) - rank(b) ||
      (descending ? number(b) - number(a) : number(a) - number(b)));
  }

  decision({ row, team }) {
    return row.decision[team];
  }

  rowOf(entry, columns, teams, index) {
    const { row, n } = entry;
    const marks = [row.bound && "bound", row.drawn && "drawn"].filter(Boolean);
    const tr = make("tr", { class: row.bound ? "bound" : null, "data-row": row.name },
      make("th", { scope: "row", class: "name", title: row.about || null }, make("span", {}, row.label),
        marks.flatMap((mark) => [" ", make("small", { class: "badge" }, mark)]),
        row.budget ? make("small", { class: "budget" }, row.budget) : null));
    if (teams) tr.append(make("td", { class: "robots", tabindex: "-1" }, String(n)));
    columns.forEach((column) => {
      const value = column.value(entry);
      const place = `${column.scene ? column.scene.label : "all scenes"}, ${robots(n)}`;
      const watch = column.scene && hasTrace(row.name, column.scene.name, n);
      const lines = explain(row, place, column.metric, value, column.seconds(entry));
      if (watch) lines.push("Enter or double click: watch an episode");
      const td = make("td", { tabindex: "-1",
          class: `${column.group ? "first " : ""}${value && value.best ? "best" : ""}` }, cellContent(value));
      if (value && value.played && value.mean !== null) td.dataset.mean = value.mean;
      if (watch) td.addEventListener("dblclick", () => watchEpisode(row.name, column.scene.name, n));
      td.watch = watch ? () => watchEpisode(row.name, column.scene.name, n) : null;
      td.addEventListener("mouseenter", () => showTip(td, lines));
      td.addEventListener("mouseleave", hideTip);
      td.addEventListener("focus", () => showTip(td, lines));
      td.addEventListener("blur", hideTip);
      tr.append(td);
    });
    const seconds = this.decision(entry);
    tr.append(make("td", { class: "first decision", tabindex: "-1" },
        seconds === null ? "\u00b7" : duration(seconds)));
    tr.dataset.place = index;
    return tr;
  }

  onKey(event) {
    const td = event.target.closest("td");
    if (!td) return;
    if (event.key === "Enter" && td.watch) { hideTip(); td.watch(); return; }
    const moves = { ArrowUp: [-1, 0], ArrowDown: [1, 0], ArrowLeft: [0, -1], ArrowRight: [0, 1] };
    const line = this.cells.findIndex((cells) => cells.includes(td));
    const place = this.cells[line].indexOf(td);
    const [down, right] = moves[event.key] || (event.key === "Home" ? [0, -place] : event.key === "End"
        ? [0, this.cells[line].length - 1 - place] : [0, 0]);
    const next = (this.cells[line + down] || [])[place + right];
    if (!next || next === td) return;
    event.preventDefault();
    td.tabIndex = -1;
    next.tabIndex = 0;
    next.focus();
  }
}

function drawTables() {
  const tables = DATA.tables.map((data) => new ResultTable(data));
  byId("table-list").append(...tables.map((table) => table.node));
  if (!tables.length) byId("table-list").append(make("p", { class: "hint" }, "No tables were made."));
  radios(byId("which"), "which", [["paper", "The paper\u2019s"], ["true", "True"], ["both", "Both"]],
      shownMetrics, (value) => {
    shownMetrics = value;
    for (const table of tables) {
      if (table.sort && !table.columns().some(({ key }) => key === table.sort.key)
          && !["robots", "decision"].includes(table.sort.key)) table.sort = null;
      table.draw();
    }
  });
}
