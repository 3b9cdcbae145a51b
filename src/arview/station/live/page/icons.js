// Icons. Each verdict and state has its own outline, so that colour is not the only cue.

const PATHS = {
  pass: '<circle cx="12" cy="12" r="10"/><path class="ink" d="M7 12.5l3.4 3.4L17 9"/>',
  fail: '<path d="M7.9 2h8.2L22 7.9v8.2L16.1 22H7.9L2 16.1V7.9z"/><path class="ink" d="M8 8l8 8M16 8l-8 8"/>',
  undecided: '<path d="M12 1.8L23 21.5H1z"/><path class="ink" d="M9.6 11.2c.2-3 4.8-2.8 4.6 0-.1 1.6-2.2 1.7-2.2 3.6M12 17.9v.1"/>',
  measured: '<rect x="2" y="2" width="20" height="20" rx="3"/><path class="ink" d="M6 12h12M6 8.5v7M18 8.5v7"/>',
  not_measured: '<circle cx="12" cy="12" r="9" fill="none" stroke="currentColor" stroke-width="2.4" stroke-dasharray="3.5 3"/>' +
    '<path d="M8 12h8" stroke="currentColor" stroke-width="2.4"/>',
  missing: '<g fill="none" stroke="currentColor" stroke-width="2.6"><rect x="2.5" y="2.5" width="19" height="19" stroke-dasharray="4 3"/>' +
    '<path d="M7.5 7.5l9 9M16.5 7.5l-9 9"/></g>',
  displaced: '<rect x="2" y="2" width="9" height="9" fill="none" stroke="currentColor" stroke-width="2.4" stroke-dasharray="3 2.4"/>' +
    '<path d="M13 13h9v9h-9z"/><path d="M7 7l7 7" fill="none" stroke="currentColor" stroke-width="2.4"/>',
  next: '<path d="M12 2v12M6 9l6 6 6-6M3 21h18" fill="none" stroke="currentColor" stroke-width="2.8"/>',
  wrong: '<path d="M2 2h20v20H2z" fill="none" stroke="currentColor" stroke-width="2.6"/><path d="M7.5 7.5l9 9M16.5 7.5l-9 9" fill="none" stroke="currentColor" stroke-width="2.6"/>',
  none: '<circle cx="12" cy="12" r="4"/>',
  tracked: '<circle cx="12" cy="12" r="10"/><path class="ink" d="M7 12.5l3.4 3.4L17 9"/>',
  critical: '<path d="M12 1.8L23 21.5H1z"/><path class="ink" d="M12 8.5v6M12 17.9v.1"/>',
  searching: '<g fill="none" stroke="currentColor" stroke-width="2.8"><circle cx="10" cy="10" r="7"/><path d="M15.2 15.2L22 22"/></g>',
  lost: '<path d="M7.9 2h8.2L22 7.9v8.2L16.1 22H7.9L2 16.1V7.9z"/><path class="ink" d="M8 8l8 8M16 8l-8 8"/>',
  align: '<g fill="none" stroke="currentColor" stroke-width="2.4"><path d="M3 8V3h5M16 3h5v5M21 16v5h-5M8 21H3v-5"/><circle cx="12" cy="12" r="3.4"/></g>',
  offline: '<g fill="none" stroke="currentColor" stroke-width="2.4"><path d="M3 9a14 14 0 0118 0M6.5 13a9 9 0 0111 0M10 17a4 4 0 014 0M3 21L21 3"/></g>',
  busy: '<g fill="none" stroke="currentColor" stroke-width="2.4"><circle cx="12" cy="12" r="9"/><path d="M12 6.5V12l4 2.5"/></g>',
  camera: '<path d="M8 5l1.5-2h5L16 5h4a2 2 0 012 2v11a2 2 0 01-2 2H4a2 2 0 01-2-2V7a2 2 0 012-2z"/><circle class="hole" cx="12" cy="12.3" r="4.2"/>',
  info: '<circle cx="12" cy="12" r="10"/><path class="ink" d="M12 11v6M12 7v.1"/>',
  warning: '<path d="M12 1.8L23 21.5H1z"/><path class="ink" d="M12 8.5v6M12 17.9v.1"/>',
  error: '<path d="M7.9 2h8.2L22 7.9v8.2L16.1 22H7.9L2 16.1V7.9z"/><path class="ink" d="M12 7v6.5M12 17v.1"/>',
  pause: '<path d="M6 4h4v16H6zM14 4h4v16h-4z"/>',
  play: '<path d="M6 3.5v17L20 12z"/>',
  record: '<circle cx="12" cy="12" r="8"/>',
  stop: '<path d="M5 5h14v14H5z"/>',
  list: '<g fill="none" stroke="currentColor" stroke-width="2.6"><path d="M9 6h12M9 12h12M9 18h12M3.5 6h1M3.5 12h1M3.5 18h1"/></g>',
  view: '<g fill="none" stroke="currentColor" stroke-width="2.4"><path d="M4 7h9M19 7h1M4 17h1M11 17h9"/><circle cx="16" cy="7" r="2.8"/><circle cx="8" cy="17" r="2.8"/></g>',
  close: '<path d="M5 5l14 14M19 5L5 19" fill="none" stroke="currentColor" stroke-width="2.8"/>',
  pen: '<path d="M4 20l1-5L16 4l4 4L9 19zM14 6l4 4" fill="none" stroke="currentColor" stroke-width="2.4" stroke-linejoin="round"/>',
  plus: '<path d="M12 4v16M4 12h16" fill="none" stroke="currentColor" stroke-width="2.8"/>',
  minus: '<path d="M4 12h16" fill="none" stroke="currentColor" stroke-width="2.8"/>',
  fit: '<g fill="none" stroke="currentColor" stroke-width="2.6"><path d="M9 4H4v5M15 4h5v5M20 15v5h-5M9 20H4v-5"/><rect x="9" y="9" width="6" height="6"/></g>',
  follow: '<g fill="none" stroke="currentColor" stroke-width="2.4"><circle cx="12" cy="12" r="6"/><path d="M12 2v5M12 17v5M2 12h5M17 12h5"/></g>',
  undo: '<path d="M9 4L4 9l5 5M4 9h10a6 6 0 010 12h-4" fill="none" stroke="currentColor" stroke-width="2.6"/>',
  back: '<path d="M15 4l-8 8 8 8" fill="none" stroke="currentColor" stroke-width="2.8"/>',
};

/** An icon as an SVG element that is hidden from assistive technology. */
export function icon(name) {
  const svg = document.createElementNS("http://www.w3.org/2000/svg", "svg");
  svg.setAttribute("viewBox", "0 0 24 24");
  svg.setAttribute("aria-hidden", "true");
  svg.classList.add("icon", `icon-${name}`);
  svg.innerHTML = PATHS[name] ?? PATHS.none;
  return svg;
}

/** An element with classes, children and attributes. */
export function make(tag, classes = "", children = [], attributes = {}) {
  const element = document.createElement(tag);
  if (classes) element.className = classes;
  element.append(...children);
  for (const [name, value] of Object.entries(attributes)) element.setAttribute(name, value);
  return element;
}
