// One method in the player: its map, metrics and curves.
const TRACES = DATA.traces.episodes;
const CURVES = ["explo_paper", "explo_true", "cover"];
const decoded = new Map();
const traceOf = (row, scene, n, episode) => TRACES.find((one) =>
  one.row === row && one.scene === scene && one.n_agents === n
      && (episode === undefined || one.episode === episode));
const hasTrace = (row, scene, n) => Boolean(traceOf(row, scene, n));
const distinct = (values) => [...new Set(values)];

function episodeOf(data) {
  if (!decoded.has(data)) decoded.set(data, new Episode(data));
  return decoded.get(data);
}

// Outlines on a grid of 24 x 24.
const ICONS = {
  first: "M5 4h3v16H5zM20 4v16L9 12z", back: "M17 4v16L6 12z", play: "M7 3l13 9-13 9z",
  pause: "M6 4h4v16H6zM14 4h4v16h-4z", forward: "M7 4v16l11-8z", last: "M16 4h3v16h-3zM4 4v16l11-8z",
};
const icon = (name) => make("svg:svg", { viewBox: "0 0 24 24", "aria-hidden": "true" },
    make("svg:path", { d: ICONS[name] }));

/** Map, metrics and curves of one method. */
class Pane {
  constructor() {
    this.title = make("h3", {});
    this.canvas = make("canvas", { role: "img" });
    this.numbers = make("dl", { class: "numbers" });
    this.chart = make("svg:svg", { class: "chart", viewBox: "0 0 300 96", preserveAspectRatio: "none",
        "aria-hidden": "true" });
    this.more = make("p", { class: "more" });
    this.plot = make("div", { class: "plot" }, this.chart);
    this.node = make("div", { class: "pane" }, this.title, make("div", { class: "stage" }, this.canvas),
        this.numbers, this.plot, this.more);
    this.values = {};
    for (const name of CURVES) {
      this.values[name] = make("dd", {});
      this.numbers.append(make("div", {}, make("dt", { class: `line ${name}` }, metricName(name)),
          this.values[name]));
    }
  }

  load(data, highest) {
    this.episode = episodeOf(data);
    this.title.textContent = DATA.rows[data.row].label;
    const seed = data.training_seed;
    if (seed !== null) this.title.append(make("small", {}, ` training seed ${seed}`));
    this.highest = highest;
    const { steps, curves } = this.episode;
    const y = (value) => 92 - (86 * value) / highest;
    const lines = [0.5, 1].map((value) => make("svg:line",
        { class: "tick", x1: 0, x2: 300, y1: y(value), y2: y(value) }));
    const paths = CURVES.map((name) => {
      const points = curves[name].map((value, t) => `${(300 * t) / steps},${y(value).toFixed(2)}`);
      return make("svg:polyline", { class: `curve ${name}`, points: points.join(" ") });
    });
    this.cursor = make("svg:line", { class: "cursor", y1: 0, y2: 96 });
    this.chart.replaceChildren(...lines, ...paths, this.cursor);
    const labels = [0.5, 1].map((value) => {
      const label = make("span", { class: "axis", "aria-hidden": "true" }, `${100 * value} %`);
      label.style.top = `${(100 * y(value)) / 96}%`;
      return label;
    });
    this.plot.replaceChildren(this.chart, ...labels);
  }

  show(t, fraction, options) {
    drawMap(this.canvas, this.episode, Math.min(t, this.episode.steps), fraction, options);
    if (t === this.shownStep && this.shownEpisode === this.episode) return;
    const at = Math.min(t, this.episode.steps);
    const { counts, curves, nTargets } = this.episode;
    for (const name of CURVES) this.values[name].textContent = `${fixed(100 * curves[name][at])} %`;
    const x = (300 * at) / this.episode.steps;
    this.cursor.setAttribute("x1", x);
    this.cursor.setAttribute("x2", x);
    this.canvas.setAttribute("aria-label", `Map of ${this.title.textContent}, ${this.text(at)}`);
    const frontier = this.episode.frontier(at).length, links = this.episode.links(at).length;
    Object.assign(this.node.dataset, { step: at, seen: counts.seen[at], seenFree: counts.seenFree[at],
        covered: counts.covered[at], frontier, links, row: this.episode.data.row });
    this.more.textContent = `${counts.covered[at]} of ${nTargets} targets covered, `
      + `${this.episode.openTargets(at)} more known; ${frontier} frontier cells; ${links} links`;
    this.shownStep = t;
    this.shownEpisode = this.episode;
  }

  text(t) {
    const percent = (name) => `${fixed(100 * this.episode.curves[name][t])} %`;
    return `step ${t}: explored ${percent("explo_paper")} as the paper counts, `
      + `${percent("explo_true")} truly, covered ${percent("cover")}`;
  }
}
