// Settings for the renderer of this machine. Without a GPU (virtual machines, old terminals) WebGL and canvases are
// drawn by the processor: then antialiasing is switched off, and canvases stay in main memory.

function rendererName() {
  const context = document.createElement("canvas").getContext("webgl2");
  if (!context) return "";
  const info = context.getExtension("WEBGL_debug_renderer_info");
  const name = String(context.getParameter(info ? info.UNMASKED_RENDERER_WEBGL : context.RENDERER));
  context.getExtension("WEBGL_lose_context")?.loseContext();
  return name;
}

const isSoftware = /swiftshader|llvmpipe|softpipe|software|basic render/i.test(rendererName());

/** Options of getContext("2d") for pictures. */
export const CANVAS_OPTIONS = { alpha: false, willReadFrequently: isSoftware };

/** Samples of antialiasing; lines are smooth without it. */
export const SAMPLES = isSoftware ? 0 : 4;
