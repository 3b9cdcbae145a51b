// Elements, icons and small formatting helpers.

const PATHS = {
  undo: '<path d="M8 4L3 9l5 5M4 9h10a6 6 0 010 12h-4"/>',
  redo: '<path d="M16 4l5 5-5 5M20 9H10a6 6 0 000 12h4"/>',
  export: '<path d="M12 3v12M7 8l5-5 5 5M4 15v5h16v-5"/>',
  save: '<path d="M4 4h13l3 3v13H4zM8 4v6h8V4M8 20v-6h8v6"/>',
  close: '<path d="M5 5l14 14M19 5L5 19"/>',
  open: '<path d="M6 9l6 6 6-6"/>',
  eye: '<path d="M2 12s4-7 10-7 10 7 10 7-4 7-10 7S2 12 2 12z"/><circle cx="12" cy="12" r="3"/>',
  hidden: '<path d="M2 12s4-7 10-7 10 7 10 7-4 7-10 7S2 12 2 12zM4 20L20 4"/>',
  pass: '<circle cx="12" cy="12" r="10"/><path d="M7 12.5l3.4 3.4L17 9"/>',
  fail: '<path d="M7.9 2h8.2L22 7.9v8.2L16.1 22H7.9L2 16.1V7.9z"/><path d="M8 8l8 8M16 8l-8 8"/>',
  warning: '<path d="M12 1.8L23 21.5H1z"/><path d="M12 8.5v6M12 17.9v.1"/>',
  note: '<circle cx="12" cy="12" r="10"/><path d="M12 11v6M12 7v.1"/>',
  trash: '<path d="M4 6h16M9 6V3h6v3M6 6l1 15h10l1-15"/>',
};

/** An icon as an SVG element that is hidden from assistive technology. */
export function icon(name) {
  const svg = document.createElementNS("http://www.w3.org/2000/svg", "svg");
  svg.setAttribute("viewBox", "0 0 24 24");
  svg.setAttribute("aria-hidden", "true");
  svg.classList.add("icon", `icon-${name}`);
  svg.innerHTML = PATHS[name] ?? PATHS.note;
  return svg;
}

/** An element; `attributes` may hold listeners as functions (onclick) and properties of the element. */
export function make(tag, attributes = {}, ...children) {
  const element = document.createElement(tag);
  for (const [name, value] of Object.entries(attributes)) {
    if (value === undefined || value === null) continue;
    if (typeof value === "function") element.addEventListener(name.slice(2), value);
    else if (name === "class") element.className = value;
    else if (name in element && typeof value !== "string") element[name] = value;
    else element.setAttribute(name, value);
  }
  element.append(...children.flat().filter((child) => child !== null && child !== undefined));
  return element;
}

export const find = (id) => document.getElementById(id);

/** A labelled row of a form. */
export function field(label, control, hint = "") {
  return make("label", { class: "field" }, make("span", {}, label), control, hint ? make("small", {}, hint) : null);
}

/** An input of a number that calls back with a number, or null where it is empty. */
export function numberInput({ value, onValue, ...attributes }) {
  const input = make("input", { type: "number", inputmode: "decimal", step: "any", ...attributes });
  input.value = value ?? "";
  input.addEventListener("change", () => {
    if (input.validity.badInput) return;
    onValue(input.value === "" ? null : Number(input.value));
  });
  return input;
}

/** A number without needless digits. */
export function shown(value, digits = 2) {
  return value === null || value === undefined ? "–" : String(Number(value.toFixed(digits)));
}

export const percent = (share) => `${Math.round(100 * share)}%`;

/** Call a function once, some time after the last call. */
export function delayed(work, wait_ms) {
  let timer = 0;
  return (...values) => {
    clearTimeout(timer);
    timer = setTimeout(() => work(...values), wait_ms);
  };
}
