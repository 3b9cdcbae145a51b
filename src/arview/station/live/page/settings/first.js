// Applies the chosen colours and text size before the page is drawn for the first time; not a module, so that it can. It also
// keeps the errors of the page's own scripts, for whoever looks for a fault.

globalThis.arviewErrors = [];
addEventListener("error", (event) => globalThis.arviewErrors.push(String(event.error?.stack ?? event.message)));
addEventListener("unhandledrejection", (event) => globalThis.arviewErrors.push(String(event.reason?.stack ?? event.reason)));

globalThis.arviewLook = (() => {
  const KEY = "arview-look", SCALES = { normal: 1, large: 1.2, largest: 1.45 };
  const light = matchMedia("(prefers-color-scheme: light)"), contrast = matchMedia("(prefers-contrast: more)");
  const look = { theme: "auto", size: "normal" };
  try {
    Object.assign(look, JSON.parse(localStorage.getItem(KEY) ?? "{}"));
  } catch { /* without storage the choice lasts until the page is closed */ }

  function apply() {
    const root = document.documentElement, { theme, size } = look;
    root.dataset.theme = theme !== "auto" ? theme : contrast.matches ? "contrast" : light.matches ? "light" : "dark";
    root.dataset.size = size;
    root.style.setProperty("--text-scale", SCALES[size] ?? 1);
    const color = { light: "#ffffff", contrast: "#000000" }[root.dataset.theme] ?? "#10141b";
    document.querySelector('meta[name="theme-color"]')?.setAttribute("content", color);
  }

  for (const one of [light, contrast]) one.addEventListener?.("change", apply);
  apply();
  return {
    look,
    /** Change the look, {theme} or {size}, and keep it. */
    choose(changes) {
      Object.assign(look, changes);
      try {
        localStorage.setItem(KEY, JSON.stringify(look));
      } catch { /* as above */ }
      apply();
    },
  };
})();
