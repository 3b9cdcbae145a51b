// Layout of the labels in two columns beside the part (boundary labelling, Bekos et al. 2007). Within a column the labels
// have the order of their anchors, and their rows minimise, by dynamic programming, the covered area, the distance to the
// component and the movement. Old and new rows do not overlap and have the same order, so labels that all move by the
// same fraction do not overlap either. When the order of a column changes, its labels jump. Two neighbours whose leaders
// cross for a while change places: straight leaders from one column of ports to the exchanged anchors do not cross.

const STEP_PX = 6; // spacing of the candidate rows
const COVER_COST = 60; // cost of a label that covers components entirely; an offset of a tenth of the area's height costs 1
const REACH_COST = 10, FULLNESS_COST = 3; // cost of a leader across the whole area, and of a full column
const STAY_GAIN = 1.5; // reward for staying in a column
const GLIDE = 0.2; // fraction of the remaining path that labels move in each call
const GAP_PX = 6;
const PORT_PX = 17; // height of a leader's beginning below the top of its label
const CROSSED_CALLS = 8; // calls for which leaders cross before their labels change places

export class LabelLayout {
  #columns = { left: [], right: [] }; // {key, y}
  #edges = null;
  #exchanged = new Set(); // "upper>lower" for neighbours that are not in the order of their anchors
  #crossed = { left: new Map(), right: new Map() }; // calls for which the leaders of "upper>lower" have crossed

  reset() {
    this.#columns = { left: [], right: [] };
    this.#exchanged.clear();
    this.#crossed = { left: new Map(), right: new Map() };
    this.#edges = null;
  }

  /**
   * Compute the boxes of the labels.
   * @param area {left, top, width, height} that labels may use, px.
   * @param requests [{key, width, height, x, y}], the most urgent first; x, y is the anchor.
   * @param part {left, right} extent that should not be covered, px.
   * @param covered (left, top, width, height) → share of the box that covers components, 0 to 1.
   * @param glides whether labels move gradually.
   * @returns [{key, left, top, side, isNew}]; labels without room are omitted.
   */
  place(area, requests, part, covered, glides) {
    const columns = this.#assign(area, requests, part);
    const widest = { left: 0, right: 0 };
    for (const side of ["left", "right"]) for (const one of columns[side]) widest[side] = Math.max(widest[side], one.width);
    const step = glides && this.#edges ? GLIDE : 1;
    this.#moveEdges(area, part, widest, step);
    return ["left", "right"].flatMap((side) => this.#column(side, area, columns[side], covered, step));
  }

  /** Assign labels to the columns: the nearer, the emptier, and the one in which the label already is are preferred. */
  #assign(area, requests, part) {
    const free = { left: area.height, right: area.height }, columns = { left: [], right: [] };
    const edges = this.#edges ?? part;
    for (const request of requests) {
      const cost = (side) => {
        const wasHere = this.#columns[side].some((one) => one.key === request.key);
        const reach = Math.abs(request.x - edges[side]) / area.width, fullness = 1 - free[side] / area.height;
        return REACH_COST * reach + FULLNESS_COST * fullness - (wasHere ? STAY_GAIN : 0);
      };
      const needed = request.height + GAP_PX, roomy = ["left", "right"].filter((side) => free[side] >= needed);
      if (!roomy.length) continue;
      const side = roomy.reduce((a, b) => (cost(a) <= cost(b) ? a : b));
      free[side] -= needed;
      columns[side].push(request);
    }
    return columns;
  }

  /** Move the inner edges of both columns towards the sides of the part, within the area. */
  #moveEdges(area, part, widest, step) {
    const clamp = (value, low, high) => Math.max(low, Math.min(value, high));
    const first = area.left + widest.left, last = area.left + area.width - widest.right;
    const limited = ({ left, right }) => ({
      left: clamp(left, first, last - GAP_PX), right: clamp(right, first + GAP_PX, last),
    });
    const goal = limited({ left: part.left - 2 * GAP_PX, right: part.right + 2 * GAP_PX });
    const { left, right } = this.#edges ?? goal;
    const moved = limited({ left: left + step * (goal.left - left), right: right + step * (goal.right - right) });
    this.#edges = moved.right - moved.left < GAP_PX ? goal : moved;
  }

  #column(side, area, requests, covered, step) {
    const old = this.#columns[side];
    const order = sorted(requests, old, this.#exchanged);
    const isSameOrder = order.length === old.length && order.every((one, i) => one.key === old[i].key);
    const lefts = order.map((one) => (side === "left" ? this.#edges.left - one.width : this.#edges.right));
    const limited = lefts.map((x, i) => Math.min(Math.max(x, area.left), area.left + area.width - order[i].width));
    const rows = bestRows(area, order, limited, covered, isSameOrder ? old.map((one) => one.y) : null);
    if (!rows) {
      this.#columns[side] = [];
      return [];
    }
    const share = isSameOrder ? step : 1;
    const placed = order.map((one, i) => {
      const was = isSameOrder ? old[i].y : rows[i];
      const isNew = !old.some((other) => other.key === one.key);
      return { key: one.key, y: was + share * (rows[i] - was), isNew, height: one.height };
    });
    // The area may have shrunk while labels were moving.
    let high = area.top + area.height;
    for (const one of [...placed].reverse()) {
      one.y = Math.min(one.y, high - one.height);
      high = one.y - GAP_PX;
    }
    let low = area.top;
    for (const one of placed) {
      one.y = Math.max(one.y, low);
      low = one.y + one.height + GAP_PX;
    }
    this.#columns[side] = placed;
    this.#exchange(side, order, placed);
    return placed.map(({ key, y, isNew }, i) => ({ key, left: limited[i], top: y, side, isNew }));
  }

  /** Let neighbours of a column change places whose leaders have crossed for a while. */
  #exchange(side, order, placed) {
    const line = (i) => [this.#edges[side], placed[i].y + Math.min(placed[i].height / 2, PORT_PX), order[i].x, order[i].y];
    const crossed = new Map();
    for (let i = 0; i + 1 < order.length; i++) {
      if (!cross(line(i), line(i + 1))) continue;
      const [upper, lower] = [order[i].key, order[i + 1].key], key = `${upper}>${lower}`;
      const calls = (this.#crossed[side].get(key) ?? 0) + 1;
      if (calls < CROSSED_CALLS) crossed.set(key, calls);
      else if (!this.#exchanged.delete(key)) this.#exchanged.add(`${lower}>${upper}`);
    }
    this.#crossed[side] = crossed;
  }
}

/** Whether two segments [x0, y0, x1, y1] cross. */
function cross(one, other) {
  const side = ([x0, y0, x1, y1], x, y) => (x1 - x0) * (y - y0) - (y1 - y0) * (x - x0);
  return side(one, other[0], other[1]) * side(one, other[2], other[3]) < 0 && side(other, one[0], one[1]) * side(other, one[2], one[3]) < 0;
}

/**
 * Requests from top to bottom; two previous neighbours swap only when their anchors clearly require it, or their leaders
 * would cross.
 */
function sorted(requests, old, exchanged) {
  const rank = new Map(old.map((one, i) => [one.key, i]));
  const order = [...requests].sort((a, b) => a.y - b.y || (a.key < b.key ? -1 : 1));
  for (let again = true, guard = 0; again && guard < 50; guard++) {
    again = false;
    for (let i = 0; i + 1 < order.length; i++) {
      const [a, b] = [order[i], order[i + 1]];
      const wasBelow = rank.has(a.key) && rank.has(b.key) && rank.get(a.key) > rank.get(b.key);
      if (wasBelow && b.y - a.y < 0.7 * Math.max(a.height, b.height)) {
        [order[i], order[i + 1]] = [b, a];
        again = true;
      }
    }
  }
  for (let i = 0; i + 1 < order.length; i++) {
    if (exchanged.has(`${order[i + 1].key}>${order[i].key}`)) [order[i], order[i + 1]] = [order[i + 1], order[i]];
  }
  return order;
}

/** Tops of the labels in a column, in order and without overlap, of minimal cost; null when they do not fit. */
function bestRows(area, order, lefts, covered, previous) {
  const count = order.length;
  if (!count) return [];
  const rows = [];
  for (let y = area.top; y <= area.top + area.height; y += STEP_PX) rows.push(y);
  const bottom = area.top + area.height, span = 0.1 * area.height;
  let best = null;
  const choices = [];
  order.forEach((one, i) => {
    const costs = new Float64Array(rows.length).fill(Infinity), choice = new Int32Array(rows.length).fill(-1);
    let reached = 0, low = Infinity, lowAt = -1;
    for (let k = 0; k < rows.length && rows[k] + one.height <= bottom; k++) {
      if (best) {
        const above = order[i - 1].height + GAP_PX;
        for (; reached < rows.length && rows[reached] + above <= rows[k]; reached++) {
          if (best[reached] < low) [low, lowAt] = [best[reached], reached];
        }
        if (lowAt < 0) continue;
      }
      let cost = COVER_COST * covered(lefts[i], rows[k], one.width, one.height);
      cost += ((rows[k] + one.height / 2 - one.y) / span) ** 2;
      if (previous) cost += Math.abs(rows[k] - previous[i]) / span;
      costs[k] = (best ? low : 0) + cost;
      choice[k] = lowAt;
    }
    best = costs;
    choices.push(choice);
  });
  let k = best.indexOf(Math.min(...best));
  if (!Number.isFinite(best[k])) return null;
  const result = [];
  for (let i = count - 1; i >= 0; i--) {
    result[i] = rows[k];
    k = choices[i][k];
  }
  return result;
}
