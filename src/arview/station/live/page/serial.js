// Asks for the serial number of a part: typed, scanned from a code in the picture, or as the station has read it.

import { make } from "./icons.js";
import { t } from "./texts/texts.js";

const SCAN_EVERY_MS = 250, SCAN_MS = 20_000;
const FORMATS = ["qr_code", "data_matrix", "code_128", "code_39", "ean_13"];

/** A reader of codes in pictures; null where the browser has none. */
async function reader() {
  if (!globalThis.BarcodeDetector) return null;
  const there = await BarcodeDetector.getSupportedFormats().catch(() => []);
  const formats = FORMATS.filter((one) => there.includes(one));
  return formats.length ? new BarcodeDetector({ formats }) : null;
}

/**
 * Ask for a serial number.
 * @param frame function that returns the newest picture (a canvas), or null.
 * @param seen function that returns what the station has read from the part, or "".
 * @param suggestion what stands in the field at first.
 * @returns the number, or null when the user cancels.
 */
export async function askSerial({ frame, seen, suggestion = "", title = t("serial.title") }) {
  const input = make("input", "", [], { id: "serial-number", type: "text", autocomplete: "off", autocapitalize: "characters", spellcheck: "false", maxlength: "80" });
  input.value = suggestion;
  const note = make("p", "note", [], { role: "status", "aria-live": "polite" });
  const button = (key, classes, values = {}) => make("button", `wide ${classes}`, [t(key, values)], { type: "button" });
  const scan = button("serial.scan", ""), read = button("serial.seen", "", { serial: "" }), ok = button("serial.ok", "main"), cancel = button("serial.cancel", "");
  const dialog = make("dialog", "dialog", [
    make("h2", "", [title], { id: "serial-title" }),
    make("label", "", [t("serial.field")], { for: "serial-number" }), input, note, read, scan, ok, cancel,
  ], { "aria-labelledby": "serial-title" });
  document.body.append(dialog);
  const detector = await reader();
  scan.hidden = detector === null;
  let until = 0;
  const refresh = async () => {
    const serial = seen();
    read.hidden = !serial;
    read.textContent = t("serial.seen", { serial });
    ok.disabled = input.value.trim() === "";
    if (!until) return;
    const picture = frame(), codes = picture && detector ? await detector.detect(picture).catch(() => []) : [];
    const text = (codes[0]?.rawValue || serial || "").trim();
    if (text) input.value = text;
    if (text || performance.now() > until) {
      note.textContent = text ? "" : t("serial.none");
      until = 0;
    }
  };
  const timer = setInterval(refresh, SCAN_EVERY_MS);
  const answer = await new Promise((resolve) => {
    const accept = () => { if (input.value.trim()) resolve(input.value.trim()); };
    input.addEventListener("input", refresh);
    input.addEventListener("keydown", (event) => { if (event.key === "Enter") accept(); });
    scan.addEventListener("click", () => {
      until = performance.now() + SCAN_MS;
      note.textContent = t("serial.scanning");
    });
    read.addEventListener("click", () => { if (seen()) resolve(seen()); });
    ok.addEventListener("click", accept);
    cancel.addEventListener("click", () => resolve(null));
    dialog.addEventListener("cancel", () => resolve(null));
    refresh();
    dialog.showModal();
    input.focus();
  });
  clearInterval(timer);
  dialog.close();
  dialog.remove();
  return answer;
}
