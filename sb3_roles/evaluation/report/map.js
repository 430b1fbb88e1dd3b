// An episode: what its bytes say, what follows from them, and how a step of it is drawn.
const NEVER = 255;
const bytes = (text) => Uint8Array.from(atob(text), (character) => character.charCodeAt(0));
const bits = (text, length) => {
  const packed = bytes(text);
  return Uint8Array.from({ length }, (_, k) => (packed[k >> 3] >> (7 - (k & 7))) & 1);
};

class Episode {
  constructor(data) {
    const map = DATA.traces.maps[data.map];
    this.data = data;
    this.height = map.height;
    this.width = map.width;
    const size = map.height * map.width;
    this.obstacle = bits(map.obstacle, size);
    this.target = bits(map.target, size);
    this.n = data.n_agents;
    this.position = bytes(data.position);
    this.steps = this.position.length / (2 * this.n) - 1;
    this.roles = data.roles ? bytes(data.roles) : null;
    this.seen = bytes(data.seen);
    // Per cell instead of per target.
    this.covered = new Uint8Array(size).fill(NEVER);
    const covered = bytes(data.covered);
    let next = 0;
    for (let k = 0; k < size; k++) if (this.target[k]) this.covered[k] = covered[next++];
    this.count();
  }

  /** Counts after each step, as the records have them: neither the start's view nor its targets are scored. */
  count() {
    const zeros = () => new Array(this.steps + 1).fill(0);
    this.counts = { seen: zeros(), seenFree: zeros(), covered: zeros() };
    this.nFree = this.nTargets = 0;
    for (let k = 0; k < this.seen.length; k++) {
      const free = !this.obstacle[k], seen = this.seen[k], covered = this.covered[k];
      this.nFree += free;
      this.nTargets += this.target[k];
      if (seen > 0 && seen <= this.steps) this.counts.seen[seen]++;
      if (free && seen <= this.steps) this.counts.seenFree[seen]++;
      if (covered > 0 && covered <= this.steps) this.counts.covered[covered]++;
    }
    for (const values of Object.values(this.counts)) {
      for (let t = 1; t <= this.steps; t++) values[t] += values[t - 1];
    }
    this.curves = {
      explo_paper: this.counts.seen.map((count) => count / this.nFree),
      explo_true: this.counts.seenFree.map((count) => count / this.nFree),
      cover: this.counts.covered.map((count) => count / this.nTargets),
    };
  }

  at(t, robot) {
    const k = 2 * (t * this.n + robot);
    return [this.position[k], this.position[k + 1]];
  }

  /** Role in which a robot made step t; null before the first step and without roles. */
  role(t, robot) {
    if (!this.roles || t < 1) return null;
    const role = this.roles[(t - 1) * this.n + robot];
    return role === NEVER ? null : role;
  }

  /** Explored free cells with an unexplored cell in their 3 x 3 neighborhood; off the map none is. */
  frontier(t) {
    const { width, height, seen } = this;
    const cells = [];
    for (let y = 0; y < height; y++) for (let x = 0; x < width; x++) {
      const k = y * width + x;
      if (seen[k] > t || this.obstacle[k]) continue;
      let near = false;
      for (let yy = Math.max(0, y - 1); yy <= Math.min(height - 1, y + 1) && !near; yy++)
        for (let xx = Math.max(0, x - 1); xx <= Math.min(width - 1, x + 1); xx++) near = near
            || seen[yy * width + xx] > t;
      if (near) cells.push([y, x]);
    }
    return cells;
  }

  /** Targets that the team knows and has not covered. */
  openTargets(t) {
    let n = 0;
    for (let k = 0; k < this.seen.length; k++) n += this.target[k] && this.seen[k] <= t && this.covered[k] > t;
    return n;
  }

  /** Pairs of robots strictly nearer than the communication radius. */
  links(t) {
    const pairs = [];
    for (let i = 0; i < this.n; i++) for (let j = i + 1; j < this.n; j++) {
      const [a, b] = this.at(t, i), [c, d] = this.at(t, j);
      if (Math.hypot(a - c, b - d) < this.data.radius) pairs.push([i, j]);
    }
    return pairs;
  }

  /** Where robots are drawn, as x, y in cells, and their radius: those that share a cell stand side by side. */
  places(t) {
    const groups = new Map();
    for (let i = 0; i < this.n; i++) {
      const key = this.at(t, i).join();
      groups.set(key, [...(groups.get(key) || []), i]);
    }
    const places = [];
    for (const robots of groups.values()) {
      const side = Math.ceil(Math.sqrt(robots.length));
      const pitch = side === 1 ? 0 : side === 2 ? 0.62 : 1.2 / side;
      robots.forEach((robot, k) => {
        const [y, x] = this.at(t, robot);
        const slots = robots.length === 2 ? [[-0.28, -0.28], [0.28, 0.28]][k]
            : [pitch * ((k % side) - (side - 1) / 2), pitch * (Math.floor(k / side) - (side - 1) / 2)];
        places[robot] = [x + 0.5 + slots[0], y + 0.5 + slots[1],
            side === 1 ? 0.5 : side === 2 ? 0.4 : Math.max(0.2, 0.6 / side)];
      });
    }
    return places;
  }
}

const COLORS = ["free", "unknown", "obstacle", "hidden-obstacle", "hidden-target", "frontier", "hatch", "fresh",
    "target", "target-edge", "covered", "grid", "link", "robot", "robot-edge", "explore", "cover", "role-2",
    "role-3"];
let palette = null;
function colors() {
  if (!palette) {
    const style = getComputedStyle(document.documentElement);
    palette = Object.fromEntries(COLORS.map((name) => [name, style.getPropertyValue(`--map-${name}`).trim()]));
  }
  return palette;
}
matchMedia("(prefers-color-scheme: dark)").addEventListener("change", () => { palette = null; });

const roleColor = (role) => colors()[role === null ? "robot"
    : ["explore", "cover", "role-2", "role-3"][role % 4]];
const TRAIL = 12;

/** Draw what is true after step t, with robots on their way to the next one by a fraction. */
function drawMap(canvas, episode, t, fraction, options) {
  const c = colors();
  const ratio = window.devicePixelRatio || 1;
  const cell = Math.max(1, Math.floor((canvas.parentElement.clientWidth * ratio) / episode.width));
  const [w, h] = [cell * episode.width, cell * episode.height];
  if (canvas.width !== w || canvas.height !== h) {
    canvas.width = w;
    canvas.height = h;
    canvas.style.width = `${w / ratio}px`;
  }
  const g = canvas.getContext("2d");
  g.drawImage(groundOf(canvas, episode, t, cell, options.hidden, c), 0, 0);
  const from = episode.places(t);
  const to = fraction > 0 ? episode.places(Math.min(t + 1, episode.steps)) : from;
  const between = (i, k) => (from[i][k] + (to[i][k] - from[i][k]) * fraction) * cell;
  const places = from.map((_, i) => [between(i, 0), between(i, 1), between(i, 2)]);
  if (options.trails) drawTrails(g, episode, t, cell, places);
  if (options.links) drawLinks(g, c, episode.links(t), places, ratio);
  places.forEach((place, i) => drawRobot(g, c, place, episode.role(t, i), i, episode.data.role_names, ratio));
}

/** The map below the robots; it is kept, since it changes with the steps and not with the frames. */
function groundOf(canvas, episode, t, cell, hidden, c) {
  const key = [episode, t, cell, hidden, c];
  if (!canvas.ground || key.some((part, k) => part !== canvas.ground.key[k])) {
    canvas.ground = { key, layer: drawGround(...key) };
  }
  return canvas.ground.layer;
}

function drawGround(episode, t, cell, hidden, c) {
  const { width, height, seen, obstacle, target, covered } = episode;
  const layer = make("canvas", { width: cell * width, height: cell * height });
  const g = layer.getContext("2d");
  g.fillStyle = c.unknown;
  g.fillRect(0, 0, layer.width, layer.height);
  const each = (use) => {
    for (let y = 0; y < height; y++) for (let x = 0; x < width; x++) use(y, x, y * width + x);
  };
  const colorOf = (k) => {
    if (seen[k] > t) return hidden && obstacle[k] ? c["hidden-obstacle"] : null;
    if (obstacle[k]) return c.obstacle;
    return t > 0 && seen[k] === t ? c.fresh : c.free;
  };
  each((y, x, k) => {
    const color = colorOf(k);
    if (!color) return;
    g.fillStyle = color;
    g.fillRect(x * cell, y * cell, cell, cell);
  });
  for (const [y, x] of episode.frontier(t)) drawFrontier(g, c, y, x, cell);
  if (cell >= 8) drawGrid(g, c, layer.width, layer.height, cell);
  each((y, x, k) => {
    if (!target[k] || !(seen[k] <= t || hidden)) return;
    if (covered[k] <= t) drawCovered(g, c, y, x, cell);
    else if (seen[k] <= t) drawTarget(g, c.target, c["target-edge"], y, x, cell);
    else drawTarget(g, c["hidden-target"], null, y, x, cell);
  });
  return layer;
}

function drawFrontier(g, c, y, x, cell) {
  g.fillStyle = c.frontier;
  g.fillRect(x * cell, y * cell, cell, cell);
  if (cell < 7) return;
  g.save();
  g.beginPath();
  g.rect(x * cell, y * cell, cell, cell);
  g.clip();
  g.strokeStyle = c.hatch;
  g.lineWidth = Math.max(1, cell / 14);
  g.beginPath();
  for (let k = -1; k < 3; k++) {
    g.moveTo(x * cell + (k * cell) / 2, (y + 1) * cell);
    g.lineTo(x * cell + (k * cell) / 2 + cell, y * cell);
  }
  g.stroke();
  g.restore();
}

function drawGrid(g, c, w, h, cell) {
  g.fillStyle = c.grid;
  for (let x = cell; x < w; x += cell) g.fillRect(x, 0, 1, h);
  for (let y = cell; y < h; y += cell) g.fillRect(0, y, w, 1);
}

function drawTarget(g, color, edge, y, x, cell) {
  const [cx, cy, reach] = [(x + 0.5) * cell, (y + 0.5) * cell, 0.36 * cell];
  g.beginPath();
  g.moveTo(cx, cy - reach);
  g.lineTo(cx + reach, cy);
  g.lineTo(cx, cy + reach);
  g.lineTo(cx - reach, cy);
  g.closePath();
  g.fillStyle = color;
  g.fill();
  if (!edge) return;
  g.strokeStyle = edge;
  g.lineWidth = Math.max(1, cell / 14);
  g.stroke();
}

function drawCovered(g, c, y, x, cell) {
  g.beginPath();
  g.arc((x + 0.5) * cell, (y + 0.5) * cell, 0.24 * cell, 0, 2 * Math.PI);
  g.strokeStyle = c.covered;
  g.lineWidth = Math.max(1.2, 0.13 * cell);
  g.stroke();
}

function drawTrails(g, episode, t, cell, places) {
  const steps = episode.n > 8 ? TRAIL / 2 : TRAIL;
  const center = (at, i) => { const [y, x] = episode.at(at, i); return [(x + 0.5) * cell, (y + 0.5) * cell]; };
  g.lineCap = "round";
  g.lineWidth = Math.max(1.5, cell * (episode.n > 8 ? 0.12 : 0.17));
  for (let i = 0; i < episode.n; i++) {
    for (let at = Math.max(1, t - steps + 1); at <= t + 1; at++) {
      // The last stroke leads to where the robot is drawn.
      const start = center(at - 1, i), end = at > t ? places[i] : center(at, i);
      g.globalAlpha = 0.15 + 0.5 * Math.max(0, (at - t + steps) / (steps + 1));
      g.strokeStyle = roleColor(episode.role(Math.min(at, t), i));
      g.beginPath();
      g.moveTo(start[0], start[1]);
      g.lineTo(end[0], end[1]);
      g.stroke();
    }
  }
  g.globalAlpha = 1;
}

function drawLinks(g, c, pairs, places, ratio) {
  g.strokeStyle = c.link;
  g.globalAlpha = pairs.length > 20 ? 0.25 : 0.55;
  g.lineWidth = ratio;
  g.beginPath();
  for (const [i, j] of pairs) {
    g.moveTo(places[i][0], places[i][1]);
    g.lineTo(places[j][0], places[j][1]);
  }
  g.stroke();
  g.globalAlpha = 1;
}

/** Shape, color and letter by role; the number of the robot where it has none. */
function drawRobot(g, c, [x, y, share], role, index, names, ratio) {
  const radius = Math.max(share, 5.5 * ratio);
  g.beginPath();
  if (role === null || role % 4 === 0) g.arc(x, y, radius, 0, 2 * Math.PI);
  else if (role % 4 === 1) g.rect(x - 0.9 * radius, y - 0.9 * radius, 1.8 * radius, 1.8 * radius);
  else {
    const sides = role % 4 === 2 ? 3 : 6;
    for (let k = 0; k < sides; k++) g.lineTo(x + 1.15 * radius * Math.sin((2 * Math.PI * k) / sides),
        y - 1.15 * radius * Math.cos((2 * Math.PI * k) / sides));
    g.closePath();
  }
  g.fillStyle = roleColor(role);
  g.fill();
  g.lineWidth = Math.max(1.2, 0.14 * radius);
  g.strokeStyle = c["robot-edge"];
  g.stroke();
  if (radius < 5 * ratio) return;
  const text = role === null ? String(index + 1) : (names[role] || "?")[0].toUpperCase();
  g.fillStyle = c["robot-edge"];
  g.font = `700 ${Math.round(radius * (text.length > 1 ? 1.05 : 1.3))}px system-ui, sans-serif`;
  g.textAlign = "center";
  g.textBaseline = "middle";
  g.fillText(text, x, y + 0.06 * radius);
}
