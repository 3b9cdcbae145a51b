// Where labels go: two columns beside the part (boundary labelling, Bekos et al. 2007). Within a column the order is that
// of the anchors and the rows are found by dynamic programming over what a label would cover, how far it is from its
// component and how far it would have to move. Rows old and new are apart and in the same order, so that labels which
// all go the same fraction of their way stay apart too: they glide without touching. When the order of a column
// changes, its labels jump.

const STEP_PX = 6; // between rows that are tried
const COVER_COST = 60; // of covering components wholly; in comparison a tenth of the area's height off costs 1
const REACH_COST = 10, FULLNESS_COST = 3; // of crossing the area's width, and of the fuller column
const STAY_GAIN = 1.5; // for staying in a column
const GLIDE = 0.2; // fraction of the way gone at each call
const GAP_PX = 6;

export class LabelLayout {
  #columns = { left: [], right: [] }; // {key, y}
  #edges = null;

  reset() {
    this.#columns = { left: [], right: [] };
    this.#edges = null;
  }

  /**
   * Boxes of labels.
   * @param area {left, top, width, height} that labels may use, px.
   * @param requests [{key, width, height, x, y}], the most urgent first; x, y is what the label speaks of.
   * @param part {left, right} of what should not be covered, px.
   * @param covered (left, top, width, height) → share of the box that covers components, 0 to 1.
   * @param glides whether labels move gently.
   * @returns [{key, left, top, side, isNew}]; labels for which there is no room are left out.
   */
  place(area, requests, part, covered, glides) {
    const columns = this.#assign(area, requests, part);
    const widest = { left: 0, right: 0 };
    for (const side of ["left", "right"]) for (const one of columns[side]) widest[side] = Math.max(widest[side], one.width);
    const step = glides && this.#edges ? GLIDE : 1;
    this.#moveEdges(area, part, widest, step);
    return ["left", "right"].flatMap((side) => this.#column(side, area, columns[side], covered, step));
  }

  /** Who goes left and who right: to the column that is nearer, less full, and where the label is already. */
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

  /** Move the inner edges of both columns towards the sides of the part, as far as the area allows. */
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
    const order = sorted(requests, old);
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
    // The area may have shrunk under labels on their way.
    let low = area.top;
    for (const one of placed) {
      one.y = Math.max(one.y, low);
      low = one.y + one.height + GAP_PX;
    }
    this.#columns[side] = placed;
    return placed.map(({ key, y, isNew }, i) => ({ key, left: limited[i], top: y, side, isNew }));
  }
}

/** Requests from top to bottom; two that were neighbours change places only when they clearly have to. */
function sorted(requests, old) {
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
  return order;
}

/** Tops of labels in a column, in order and apart, of least total cost; null when they do not fit. */
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
