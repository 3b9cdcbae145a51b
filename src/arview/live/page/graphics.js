// What this machine draws with. Without a graphics card (virtual machines, old terminals) WebGL and canvases are drawn
// by the processor: then fewer samples are taken, and canvases stay in main memory instead of passing through WebGL.

function rendererName() {
  const context = document.createElement("canvas").getContext("webgl2");
  if (!context) return "";
  const info = context.getExtension("WEBGL_debug_renderer_info");
  const name = String(context.getParameter(info ? info.UNMASKED_RENDERER_WEBGL : context.RENDERER));
  context.getExtension("WEBGL_lose_context")?.loseContext();
  return name;
}

const isByProcessor = /swiftshader|llvmpipe|softpipe|software|basic render/i.test(rendererName());

/** Of getContext("2d") for pictures. */
export const CANVAS_OPTIONS = { alpha: false, willReadFrequently: isByProcessor };

/** Of antialiasing; lines are smooth without. */
export const SAMPLES = isByProcessor ? 0 : 4;
