// What is wrong, told on the page: the message that blocks it, and the notices above the picture.

import { spanText } from "./status.js";
import { t } from "./texts/texts.js";
import { partsOf } from "./transport/api.js";

const FUTURE_S = 60; // clocks that differ by less are not worth a notice

/** The text of a phase that tries again by itself. */
export function retryText({ text, inS }) {
  if (!inS) return text;
  return inS >= 2 ? t("retry.every", { text, seconds: Math.round(inS) }) : t("retry.soon", { text });
}

/**
 * The message about what has to be resolved before the page can show anything, or null.
 * @param state {phase, trouble, part, status} of the page.
 * @param acts {retry, startCamera, hasPicture: whether a picture has come}
 */
export function blocking({ phase, trouble, part, status }, { retry, startCamera, hasPicture }) {
  if (phase.name === "busy") {
    return { sign: "busy", title: t("message.busy"), text: t("message.busy.text", { text: phase.text }), button: t("message.try_now"), onPress: retry };
  }
  if (phase.name === "denied") {
    return { sign: "offline", title: t("message.denied"), text: `${phase.text}.`, button: t("message.try_again"), onPress: () => location.reload() };
  }
  if (phase.name === "retrying") {
    return { sign: "offline", title: t("message.lost"), text: `${phase.text}.`, button: t("message.try_now"), onPress: retry };
  }
  if (phase.name === "loading" && phase.text) return { sign: "busy", title: t("message.loading"), text: phase.text, button: "" };
  if (part?.source === "phone" && trouble) {
    return { sign: "camera", title: t("message.no_camera"), text: trouble, button: t("message.try_again"), onPress: startCamera };
  }
  if (part?.source === "station" && status?.feed?.state === "reconnecting" && !hasPicture) {
    return { sign: "camera", title: t("message.no_camera"), text: t("message.station_camera"), button: "" };
  }
  return null;
}

/**
 * All notices: those of the server, and those that only the page knows.
 * @param state {status, part} of the page.
 * @param page {hasGhost, fallback}: whether this browser draws the overlay, and why WebRTC is not used.
 */
export function allNotices({ status, part }, { hasGhost, fallback }) {
  const shown = [...(status?.notices ?? [])];
  if (status?.feed && ["reconnecting", "frozen"].includes(status.feed.state) && !shown.some((one) => one.code.startsWith("source_"))) {
    shown.push({ code: `source_${status.feed.state}`, level: "error", text: status.feed.text });
  }
  for (const [index, one] of shown.entries()) if (one.code?.startsWith("source_")) shown[index] = { ...one, text: t("notice.source", { text: one.text }) };
  const isTold = shown.some((one) => one.code === "inspection_future");
  const inspections = part ? partsOf(part).map((one) => one.inspection).filter(Boolean) : [];
  const ahead = Math.max(0, ...inspections.map(({ created }) => (Date.parse(created) - Date.now()) / 1000), ...inspections.map(({ age_s }) => -age_s));
  if (ahead > FUTURE_S && !isTold) shown.push({ code: "inspection_future", level: "warning", text: t("notice.future", { ahead: spanText(ahead) }) });
  for (const { note } of inspections) if (note) shown.push({ level: "warning", text: note });
  if (!hasGhost) shown.push({ level: "warning", text: t("notice.no_webgl") });
  if (fallback === "unsupported") shown.push({ level: "warning", text: t("notice.no_webrtc") });
  return shown.filter((one) => one.level !== "info");
}
