// The episode player: one method, or two side by side in the same step of the same episode.
const SPEEDS = [1, 2, 5, 10, 20];

class Player {
  constructor(root) {
    this.state = { row: null, scene: null, n: null, episode: null, other: null };
    this.step = 0;
    this.fraction = 0;
    this.playing = false;
    this.options = { hidden: false, links: true, trails: true };
    this.still = matchMedia("(prefers-reduced-motion: reduce)");
    this.panes = [new Pane(), new Pane()];
    this.live = make("p", { class: "quiet", "aria-live": "polite", id: "live" });
    this.stepText = make("output", { id: "step-text" });
    this.stage = make("div", { class: "panes", tabindex: "0", role: "group",
        "aria-label": "Episode. Space plays and pauses, arrow keys step." },
        this.panes.map((pane) => pane.node));
    const box = make("div", { class: "player" }, this.choices(), this.stage, this.transport(), this.legend(),
        this.live);
    box.addEventListener("keydown", (event) => this.onKey(event));
    root.append(box);
    new ResizeObserver(() => this.draw()).observe(this.stage);
    matchMedia("(prefers-color-scheme: dark)").addEventListener("change", () => this.draw());
    addEventListener("hashchange", () => this.fromHash());
    const first = traceOf("hmappo", "hard", 4) || TRACES[0];
    if (!this.fromHash()) this.choose({ row: first.row, scene: first.scene, n: first.n_agents,
        episode: first.episode, other: null }, false);
  }

  choices() {
    const select = (name, label, onChange) => {
      const node = make("select", { id: `player-${name}` });
      node.addEventListener("change", () => onChange(node.value));
      this[`${name}Select`] = node;
      return make("label", {}, make("span", {}, label), node);
    };
    this.compare = make("input", { type: "checkbox", id: "player-compare" });
    this.compare.addEventListener("change", () => this.choose({ other: this.compare.checked ? this.suggestion()
        : null }));
    const other = select("other", "Beside it", (other) => this.choose({ other }));
    this.otherBox = other;
    return make("div", { class: "controls" },
      select("row", "Method", (row) => this.choose({ row })),
          select("scene", "Scene", (scene) => this.choose({ scene })),
      select("n", "Robots", (n) => this.choose({ n: Number(n) })),
          select("episode", "Episode", (episode) => this.choose({ episode: Number(episode) })),
      make("label", { class: "check" }, this.compare, make("span", {}, "Compare")), other);
  }

  transport() {
    const button = (id, label, use) => make("button",
        { type: "button", id, "aria-label": label, title: label, onclick: use }, icon(id));
    this.playButton = button("play", "Play", () => this.toggle());
    this.slider = make("input", { type: "range", id: "scrub", min: "0", value: "0", step: "1",
        "aria-label": "Step" });
    this.slider.addEventListener("input", () => { this.pause(); this.go(Number(this.slider.value)); });
    this.speed = make("select", { id: "speed" }, SPEEDS.map((value) => make("option",
        { value, selected: value === 5 }, `${value} steps/s`)));
    return make("div", { class: "transport" },
      make("div", { class: "buttons" }, button("first", "To the start", () => this.jump(0)),
          button("back", "Step back", () => this.jump(this.step - 1)), this.playButton,
        button("forward", "Step forward", () => this.jump(this.step + 1)),
            button("last", "To the end", () => this.jump(Infinity))),
      this.slider, this.stepText, make("label", {}, make("span", { class: "quiet" }, "Speed"), this.speed));
  }

  legend() {
    const toggle = (name, label) => {
      const input = make("input", { type: "checkbox", id: `show-${name}`, checked: this.options[name] });
      input.addEventListener("change", () => { this.options[name] = input.checked; this.draw(); });
      return make("label", { class: "check" }, input, make("span", {}, label));
    };
    const keys = [["unknown", "unknown"], ["free", "free"], ["fresh", "seen in this step"],
        ["obstacle", "obstacle"], ["frontier", "frontier"], ["target", "known target"],
        ["covered", "covered target"]];
    this.roleKeys = make("span", { class: "role-keys" });
    return make("div", { class: "legend" },
      make("div", { class: "toggles" }, toggle("hidden", "What the team does not know"),
          toggle("links", "Links"), toggle("trails", "Trails")),
      make("div", { class: "keys" }, keys.map(([name, label]) => make("span", { class: "key" },
          make("i", { class: `swatch ${name}` }), label)), this.roleKeys));
  }

  /** The part of a choice that exists: what was asked for last counts most. */
  choose(change, keepHash = true) {
    const wanted = { ...this.state, ...change };
    const order = "row" in change || !this.state.row ? ["row", "scene", "n", "episode"]
        : ["scene", "n", "row", "episode"];
    let left = TRACES;
    for (const key of order) {
      const of = (one) => one[key === "n" ? "n_agents" : key];
      const kept = left.filter((one) => of(one) === wanted[key]);
      if (!kept.length) wanted[key] = of(left[0]);
      left = kept.length ? kept : left.filter((one) => of(one) === wanted[key]);
    }
    if (wanted.other !== null
        && !this.rivals(wanted).includes(wanted.other)) wanted.other = this.suggestion(wanted);
    this.state = wanted;
    this.fill();
    this.load();
    if (keepHash) history.replaceState(null, "", this.hash());
  }

  rivals({ row, scene, n, episode } = this.state) {
    return TRACES.filter((one) => one.scene === scene && one.n_agents === n && one.episode === episode
        && one.row !== row).map((one) => one.row);
  }

  suggestion(state = this.state) {
    const rivals = this.rivals(state);
    return rivals.includes("greedy_assigned") ? "greedy_assigned" : rivals[0] || null;
  }

  hash() {
    const { row, scene, n, episode, other } = this.state;
    const parts = [row, scene, n, episode, other].filter((part) => part !== null);
    return `#player=${parts.map(encodeURIComponent).join(",")}`;
  }

  /** Follow the page's address; false if it says nothing about the player. */
  fromHash() {
    const found = /^#player=(.+)$/.exec(location.hash);
    if (!found) return false;
    const [row, scene, n, episode, other] = found[1].split(",").map(plainPart);
    if (!traceOf(row, scene, Number(n))) return false;
    this.choose({ row, scene, n: Number(n), episode: Number(episode) || 0, other: other || null }, false);
    byId("player").scrollIntoView();
    return true;
  }

  fill() {
    const { row, scene, n, episode, other } = this.state;
    const set = (select, values, chosen, label) => select.replaceChildren(...values.map((value) =>
      make("option", { value, selected: value === chosen }, label(value))));
    const sceneName = (name) => DATA.scenes[name] || name;
    set(this.rowSelect, distinct(TRACES.map((one) => one.row)), row, (name) => DATA.rows[name].label);
    set(this.sceneSelect, distinct(TRACES.map((one) => one.scene)), scene, sceneName);
    set(this.nSelect, distinct(TRACES.filter((one) => one.scene === scene).map((one) => one.n_agents)).sort((a,
        b) => a - b), n, String);
    set(this.episodeSelect, TRACES.filter((one) => one.row === row && one.scene === scene
        && one.n_agents === n).map((one) => one.episode), episode, String);
    const rivals = this.rivals();
    set(this.otherSelect, rivals, other, (name) => DATA.rows[name].label);
    this.compare.disabled = !rivals.length;
    this.compare.checked = other !== null;
    this.otherBox.hidden = other === null;
  }

  load() {
    const { row, scene, n, episode, other } = this.state;
    const chosen = [row, other].filter((name) => name !== null).map((name) => traceOf(name, scene, n, episode));
    const highest = Math.max(1, ...chosen.map((data) => episodeOf(data).curves.explo_paper.at(-1)));
    this.panes[1].node.hidden = chosen.length < 2;
    this.stage.classList.toggle("two", chosen.length > 1);
    chosen.forEach((data, k) => this.panes[k].load(data, highest));
    this.shown = this.panes.slice(0, chosen.length);
    this.steps = Math.max(...this.shown.map((pane) => pane.episode.steps));
    this.slider.max = this.steps;
    const names = distinct(chosen.flatMap((data) => data.role_names));
    this.roleKeys.replaceChildren(...names.map((name, role) => make("span", { class: "key" },
        make("i", { class: `glyph role-${role % 4}` }, name[0].toUpperCase()), `robot in role ${name}`)));
    if (!chosen.every((data) => data.role_names.length)) this.roleKeys.append(make("span", { class: "key" },
        make("i", { class: "glyph" }, "1"), "robot without roles"));
    this.go(Math.min(this.step, this.steps));
  }

  /** Show a step; aloud, for screen readers, only while nothing plays. */
  go(step, fraction = 0) {
    const news = step !== this.step || !this.stepText.value;
    this.step = step;
    this.fraction = fraction;
    if (news) {
      this.slider.value = step;
      this.slider.setAttribute("aria-valuetext", `step ${step} of ${this.steps}`);
    }
    this.stepText.value = `step ${step} / ${this.steps}`;
    this.draw();
    if (this.playing) return;
    const tell = (pane) => `${pane.title.textContent}, ${pane.text(Math.min(step, pane.episode.steps))}`;
    this.live.textContent = this.shown.map(tell).join("; ");
  }

  draw() {
    if (this.shown) for (const pane of this.shown) pane.show(this.step, this.fraction, this.options);
  }

  jump(step) {
    this.pause();
    this.go(Math.max(0, Math.min(step, this.steps)));
  }

  toggle() {
    if (this.playing) return this.pause();
    if (this.step >= this.steps) this.go(0);
    this.setPlaying(true);
    let last = performance.now(), clock = this.step + this.fraction;
    const frame = (now) => {
      if (!this.playing) return;
      clock += (Math.max(0, now - last) / 1000) * Number(this.speed.value);
      last = now;
      if (clock >= this.steps) {
        this.setPlaying(false);
        this.go(this.steps);
        return;
      }
      const step = Math.floor(clock);
      // Whoever prefers less motion sees robots where they are after a step, not on their way.
      if (!this.still.matches) this.go(step, clock - step);
      else if (step !== this.step) this.go(step);
      this.request = requestAnimationFrame(frame);
    };
    this.request = requestAnimationFrame(frame);
  }

  pause() {
    if (!this.playing) return;
    cancelAnimationFrame(this.request);
    this.setPlaying(false);
    this.go(this.step);
  }

  setPlaying(playing) {
    this.playing = playing;
    const label = playing ? "Pause" : "Play";
    this.playButton.replaceChildren(icon(playing ? "pause" : "play"));
    this.playButton.setAttribute("aria-label", label);
    this.playButton.title = label;
  }

  onKey(event) {
    if (event.altKey || event.ctrlKey || event.metaKey) return;
    const kind = event.target.tagName === "INPUT" ? event.target.type : event.target.tagName;
    // Lists and the slider have their own use for the arrows, buttons and boxes for the space bar.
    if (kind === "SELECT" || (kind === "range" && event.key !== " ")) return;
    if (event.key === " " && ["BUTTON", "checkbox"].includes(kind)) return;
    const uses = { " ": () => this.toggle(), ArrowLeft: () => this.jump(this.step - 1),
        ArrowRight: () => this.jump(this.step + 1), Home: () => this.jump(0), End: () => this.jump(Infinity) };
    if (!uses[event.key]) return;
    event.preventDefault();
    uses[event.key]();
  }
}

/** A part of the address; what is no such part stays as it is. */
function plainPart(part) {
  try { return decodeURIComponent(part); } catch { return part; }
}

const player = TRACES.length ? new Player(byId("player-body")) : null;
if (!player) byId("player-body").append(make("p", { class: "hint" }, "No episodes were recorded."));

/** Go to the player with the first episode of a cell of a table. */
function watchEpisode(row, scene, n) {
  const { episode } = traceOf(row, scene, n);
  player.pause();
  player.choose({ row, scene, n, episode });
  player.go(0);
  byId("player").scrollIntoView();
  player.stage.focus({ preventScroll: true });
}

drawStrip();
drawTables();
drawHonesty();
// The page was empty when the browser looked for what its address names.
if (/^#[\w-]+$/.test(location.hash)
    && byId(location.hash.slice(1))) byId(location.hash.slice(1)).scrollIntoView();
if (player && location.hash.startsWith("#player=")) {
  byId("player").scrollIntoView();
  // So that the keys work at once.
  player.stage.focus({ preventScroll: true });
}
