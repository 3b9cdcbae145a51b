// The page: connects camera, connection, picture and controls.

import { Camera, quarterTurns } from "./camera.js";
import { CameraControls } from "./settings/camera_controls.js";
import { Connection } from "./transport/connection.js";
import { connectKeys } from "./keys.js";
import { Devices } from "./lists/devices.js";
import { Files } from "./lists/files.js";
import { allNotices, blocking, retryText } from "./faults.js";
import { askSerial } from "./serial.js";
import { clock, errorText, t, translate } from "./texts/texts.js";
import { connectLook } from "./settings/look.js";
import { icon } from "./icons.js";
import { keepSnapshot } from "./lists/snapshots.js";
import { PartLists, tally } from "./parts.js";
import { Player } from "./player.js";
import { Specimens, reasonOf, summaryOf } from "./specimens.js";
import { Sheet } from "./sheet.js";
import { Stage } from "./scene/stage.js";
import { mountJob } from "./job/job.js";
import { partsOf } from "./transport/api.js";
import { Message, Notices, StatusBar, Toast } from "./status.js";
import { save, share } from "./lists/share.js";
import { ZoomControls } from "./scene/zoom_controls.js";

const FIGURES_EVERY_MS = 500, STYLE_DELAY_MS = 150, SCREEN_STEP_PX = 16, MAX_DENSITY = 2;
const FIGURES_KEY = "arview-figures";
const SILENT_MS = 3000; // the server sends a status every second: after this its figures are old
const find = (id) => document.getElementById(id);

history.replaceState(null, "", location.pathname); // the token stays out of bookmarks and shared links
translate();
for (const sign of document.querySelectorAll("[data-icon]")) sign.append(icon(sign.dataset.icon));

const style = { ghost: true, edges: "visible", labels: true, opacity: 0.42, only: null, only_part: 0, status: false };
const state = { phase: { name: "loading", text: "" }, part: null, status: null, trouble: "", latencies: [], isRecording: false, heardMs: null };
const listeners = new Map(); // what other parts of the page wait for: see host
const tell = (name, about) => listeners.get(name)?.forEach((act) => act(about));

let player = null, isDrawAsked = false;

const bar = new StatusBar({
  icon: find("state-icon"), word: find("state-name"), why: find("state-why"), quality: find("quality"),
  meter: find("quality-meter"), latency: find("latency"), age: find("age"), stale: find("figures-stale"), body: document.body,
});
const notices = new Notices(find("notices")), message = new Message(find("message")), toast = new Toast(find("toast"));
const parts = new PartLists(find("panels"), find("card"), isolate);
const specimens = new Specimens({ list: find("specimens"), confirms: find("confirms"), confirm: find("confirm") }, confirmPart);
const stage = new Stage({
  stage: find("stage"), canvas: find("picture"), leaders: find("leaders"), labels: find("labels"),
  obstacles: [find("bar"), find("notices"), find("actions"), find("card"), find("side")], controls: find("zoom"),
}, style, isolate, () => {
  requestDraw();
  zoom.show();
  tellScreen();
});
const zoom = new ZoomControls(find("zoom"), stage);
const files = new Files(find("file-lists"), (text) => toast.show(text));
const devices = new Devices(find("device-list"), (text) => toast.show(text));
const sheet = new Sheet(find("side"), (section) => {
  if (section === "files") files.refresh();
  if (section === "devices") devices.refresh();
  stage.measure();
});
// On a large screen all sections stand beside the picture: lists are asked for when they come into view.
for (const [id, lists] of [["files", files], ["devices", devices]]) {
  new IntersectionObserver((seen) => { if (!sheet.open && seen.at(-1).isIntersecting) lists.refresh(); }).observe(find(id));
}
const camera = new Camera(find("camera"), takeCameraFrame, (trouble) => {
  state.trouble = trouble;
  refresh();
});
const cameraControls = new CameraControls(find("camera-controls"), camera, (text) => toast.show(text));
camera.onStart = () => cameraControls.refresh();
const connection = new Connection(find("remote"), {
  onPhase(phase) {
    state.phase = phase;
    if (phase.name !== "connected") player?.reset();
    refresh();
    tell("phase", phase);
  },
  onPart(part) {
    state.part = part;
    player ??= new Player(part.source === "phone");
    document.body.dataset.source = part.source;
    const all = partsOf(part);
    document.title = `${titleOf(all)} · arview`;
    parts.setParts(all);
    specimens.setParts(all);
    showBadge(all.flatMap((one) => one.components));
    stage.setPart(part);
    stage.isFollowing = part.source === "station";
    if (style.only && !all[style.only_part]?.components.some((one) => one.name === style.only)) isolate(null);
    if (part.source === "phone" && !camera.isOn && !state.trouble) camera.start(part.wanted);
    requestDraw();
    tell("part", part);
  },
  async onModels(buffers, part) {
    await stage.setModels(buffers, part);
  },
  onOpen() {
    player.mode = connection.mode;
    sendStyle();
    sentScreen = "";
    tellScreen();
    if (connection.fallback) toast.show(t(`link.${connection.fallback}`));
  },
  onPose(pose) {
    state.heardMs = performance.now();
    player.takePose(pose, state.heardMs);
    requestDraw();
    tell("pose", pose);
  },
  onStatus(status) {
    const before = state.status?.recording.finished ?? status.recording.finished;
    state.status = status;
    state.heardMs = performance.now();
    if (status.mode) player.mode = status.mode;
    const finished = status.recording.finished.filter((number) => !before.includes(number));
    if (finished.length && state.isRecording) offerRecording(finished.at(-1));
    if (!status.recording.is_on && finished.length) state.isRecording = false;
    refresh();
    tellScreen();
    tell("status", status);
  },
  onFrame(source, width, height, id, moment) {
    player.takeSent(source, width, height, id, moment);
    requestDraw();
  },
});

// --- pictures ---------------------------------------------------------------------------------------

function takeCameraFrame(video, takenMs) {
  if (!player) return;
  const { link } = connection;
  const frame = player.takeOwn(video, takenMs, quarterTurns(), link?.inFlight);
  if (!frame) return;
  link?.send(frame);
  requestDraw();
}

function requestDraw() {
  if (isDrawAsked) return;
  isDrawAsked = true;
  requestAnimationFrame(() => {
    isDrawAsked = false;
    draw();
  });
}

let drawn = { frame: null };

function draw() {
  if (!player) return;
  const shown = player.choose(performance.now()), { frame, pose, guide } = shown;
  const isSame = frame === drawn.frame && frame?.order === drawn.order && pose === drawn.pose && guide === drawn.guide;
  if (!isSame || stage.isChanged) {
    stage.draw(shown);
    parts.setEvidence(pose);
    note(shown, isSame);
  }
  refreshState(shown);
}

/** Note when a picture was shown, and dispatch an event for listeners. */
function note({ frame, pose, guide, isAnnotated }, isSame) {
  const nowMs = performance.now();
  if (frame && !isSame) {
    // A station's picture was in transit before it arrived at this page.
    const before = player.isPhone ? 0 : (pose?.server_ms ?? 0) + (connection.link?.rttMs ?? 0) / 2;
    state.latencies.push({ atMs: nowMs, ms: nowMs - frame.takenMs + before });
    drawn = { frame, order: frame.order, pose, guide, takenMs: frame.takenMs - before };
  }
  const detail = { id: frame?.id ?? null, pose, isAnnotated, takenMs: frame?.takenMs ?? null, drawnMs: nowMs };
  document.dispatchEvent(new CustomEvent("arview:drawn", { detail }));
  tell("drawn", pose);
}

// --- status and figures ------------------------------------------------------------------------------

function refreshState(shown = player?.shown) {
  const { phase, trouble, status, part } = state;
  const nowMs = performance.now();
  const isLive = !player?.isFrozen && phase.name === "connected" && player.isAnswered(nowMs);
  specimens.show(isLive ? shown?.pose ?? player.answer : null);
  if (player?.isFrozen) {
    const ago = Math.round((Date.now() - player.frozenAt) / 1000);
    return bar.show("frozen", ago < 2 ? t("frozen.now") : t("frozen.ago", { seconds: ago }));
  }
  if (phase.name !== "connected") return bar.show(phase.name, retryText(phase));
  if (part?.source === "phone" && trouble) return bar.show("trouble"); // why, and what to do, is in the message
  if (!player.isAnswered(nowMs)) {
    const words = status?.feed?.text || t(camera.isOn || part?.source !== "phone" ? "why.station" : "why.camera");
    return bar.show("waiting", words);
  }
  const answer = shown?.pose ?? player.answer;
  if (answer.guide_cam_from_model && !answer.cam_from_model) {
    return bar.show("align", t("why.align"));
  }
  if (specimens.isSeveral && answer.parts.length > 1) return bar.show(...summaryOf(answer.parts, specimens.names));
  bar.show(answer.state, reasonOf(answer));
}

function refresh() {
  if (player) refreshState();
  else bar.show(state.phase.name, retryText(state.phase));
  const { status } = state;
  notices.show(allNotices(state, { hasGhost: stage.hasGhost, fallback: connection.fallback }));
  message.show(blocking(state, { retry: () => connection.retryNow(), startCamera: () => camera.start(state.part.wanted), hasPicture: Boolean(player?.shown?.frame) }));
  const { recording } = status ?? {};
  setPressed("record", Boolean(recording?.is_on), recording?.is_on ? "stop" : "record", recording?.is_on ? clock(recording.seconds) : t("actions.record"));
  if (recording?.is_on) find("record").setAttribute("aria-label", t("actions.record_stop", { time: clock(recording.seconds) }));
  else find("record").removeAttribute("aria-label");
  const link = connection.link;
  find("link-state").textContent = link
    ? [t(link.kind === "jpeg" ? "link.by_jpeg" : "link.by_webrtc", { mode: t(`link.mode.${player.mode === "video" ? "video" : "poses"}`) }),
      status?.feed ? t("link.rates", { tracked: status.feed.tracked_fps.toFixed(0), received: status.feed.received_fps.toFixed(0) }) : "",
      link.rttMs === null ? "" : t("link.network", { ms: link.rttMs.toFixed(0) })].filter(Boolean).join("; ")
    : t("link.none");
}

/** For how long nothing has come from the server, s; null while it responds. */
function staleFor(nowMs) {
  const { heardMs, phase } = state, silentMs = nowMs - heardMs;
  return heardMs !== null && (phase.name !== "connected" || silentMs > SILENT_MS) ? silentMs / 1000 : null;
}

/** Show on the button of the parts how many failed, or are undecided. */
function showBadge(components) {
  const button = find("open-parts");
  button.querySelector(".badge")?.remove();
  button.removeAttribute("aria-label");
  const bad = tally(components).find((one) => one.classList.contains("fail") || one.classList.contains("undecided"));
  if (!bad) return;
  const badge = document.createElement("span");
  badge.className = `badge ${bad.classList[1]}`;
  badge.append(icon(bad.classList[1]), bad.textContent.split(" ")[0]);
  button.append(badge);
  button.setAttribute("aria-label", t("actions.badge", { count: bad.textContent }));
}

setInterval(() => {
  const nowMs = performance.now();
  state.latencies = state.latencies.filter((one) => nowMs - one.atMs < 2000);
  const sorted = state.latencies.map((one) => one.ms).sort((a, b) => a - b);
  const pose = player?.shown?.pose, isAnswered = state.phase.name === "connected" && player?.isAnswered(nowMs);
  bar.figures({
    quality: pose?.isPosed ? Math.min(...pose.parts.filter((one) => one.cam_from_model).map((one) => one.quality)) : pose?.quality ?? null,
    latencyMs: isAnswered && sorted.length ? sorted[sorted.length >> 1] : null,
    ageMs: isAnswered && drawn.frame ? nowMs - drawn.takenMs : null,
    staleS: staleFor(nowMs),
  });
  parts.setStale(staleFor(nowMs));
  requestDraw(); // removes the overlay when no poses arrive
  refresh();
}, FIGURES_EVERY_MS);

// --- controls ---------------------------------------------------------------------------------------

function isolate(name, part = 0) {
  Object.assign(style, { only: name, only_part: name ? part : 0 });
  parts.show(name, part);
  changeStyle();
  tell("isolate", { name, part });
}

let styleTimer = 0;

function changeStyle() {
  stage.setStyle(style);
  requestDraw();
  clearTimeout(styleTimer);
  styleTimer = setTimeout(sendStyle, STYLE_DELAY_MS);
}

/** Make the server draw in the same style: for annotated video, snapshots and recordings. */
async function sendStyle() {
  if (connection.link) await connection.ask({ style });
}

function setPressed(id, isPressed, sign, text) {
  const button = find(id), words = button.querySelector(".sign + span");
  button.setAttribute("aria-pressed", String(isPressed));
  if (words.textContent !== text) {
    words.textContent = text;
    button.querySelector(".sign").replaceChildren(icon(sign));
  }
}

let sentScreen = "", screenTimer = 0;

/** Tell the server how large its annotated video is shown, so that it draws labels that can be read there. */
function tellScreen() {
  clearTimeout(screenTimer);
  screenTimer = setTimeout(() => {
    const { size } = stage, { link } = connection;
    if (!link || !size || player?.mode !== "video") return;
    const density = Math.min(devicePixelRatio || 1, MAX_DENSITY), step = (px) => SCREEN_STEP_PX * Math.max(1, Math.round((px * density) / SCREEN_STEP_PX));
    const screen = { width: step(size.width), height: step(size.height), density }, key = JSON.stringify(screen);
    if (key === sentScreen) return;
    sentScreen = key;
    connection.ask({ screen });
  }, STYLE_DELAY_MS);
}

function freeze() {
  if (!player?.shown?.frame) return;
  player.isFrozen = !player.isFrozen;
  player.frozenAt = Date.now() - (performance.now() - player.shown.frame.takenMs);
  document.body.classList.toggle("is-frozen", player.isFrozen);
  setPressed("freeze", player.isFrozen, player.isFrozen ? "play" : "pause", t(player.isFrozen ? "actions.resume" : "actions.freeze"));
  connection.ask({ hold: player.isFrozen ? player.shown.frame.id : null });
  requestDraw();
}

async function snapshot() {
  const { link } = connection, frame = player?.shown?.frame;
  if (!link || !frame) return toast.show(t("snapshot.none"));
  try {
    clearTimeout(styleTimer);
    await connection.ask({ hold: frame.id, style });
    const answer = await fetch(`/api/clients/${link.client}/snapshot.png?id=${frame.id}`, { cache: "no-store" });
    if (!answer.ok) throw new Error(errorText(await answer.json()));
    const moment = new Date().toISOString().slice(0, 19).replaceAll(":", "");
    const file = [titleOf(partsOf(state.part)).replaceAll(", ", "_").replaceAll(" ", "_"), moment].filter(Boolean).join("_").replace(/[^\w.-]+/g, "-");
    const blob = await answer.blob();
    save(blob, `${file}.png`);
    await keepSnapshot(`${file}.png`, blob);
    if (sheet.open === "files") files.refresh();
    toast.show(t("snapshot.saved"));
  } catch (error) {
    toast.show(t("snapshot.failed", { reason: error.message }));
  } finally {
    if (!player.isFrozen) connection.ask({ hold: null });
  }
}

/** Names and serial numbers of the parts. */
function titleOf(all) {
  return all.map(({ part, inspection, name }) => [name || part.name, inspection?.serial || part.serial].filter(Boolean).join(" ")).join(", ");
}

async function record() {
  const isOn = state.status?.recording.is_on;
  if (!isOn) state.isRecording = true;
  const refusal = await connection.ask({ record: !isOn });
  if (refusal) toast.show(t("record.failed", { reason: refusal }));
}

function offerRecording(number) {
  toast.show(t("record.finished"), { href: `/api/recordings/${number}`, text: t("record.save"), download: "" });
  if (sheet.open === "files") files.refresh();
}

function toggle(key) {
  if (key === "edges") style.edges = style.edges === "none" ? "visible" : "none";
  else style[key] = !style[key];
  find(`show-${key}`).setAttribute("aria-checked", String(key === "edges" ? style.edges !== "none" : style[key]));
  changeStyle();
}

for (const key of ["ghost", "edges", "labels"]) find(`show-${key}`).addEventListener("click", () => toggle(key));
/** The figures that only engineers need, such as the delay, are shown where they have switched them on. */
function showFigures(isOn) {
  document.body.classList.toggle("has-figures", isOn);
  find("show-figures").setAttribute("aria-checked", String(isOn));
}

find("show-figures").addEventListener("click", () => {
  const isOn = !document.body.classList.contains("has-figures");
  showFigures(isOn);
  try {
    localStorage.setItem(FIGURES_KEY, String(isOn));
  } catch { /* without storage the choice lasts until the page is closed */ }
});
showFigures(localStorage.getItem(FIGURES_KEY) === "true");
find("opacity").addEventListener("input", (event) => {
  style.opacity = Number(event.target.value);
  find("opacity-text").textContent = `${Math.round(100 * style.opacity)} %`;
  changeStyle();
});
find("search-again").addEventListener("click", async () => {
  toast.show((await connection.ask({ reset: true })) || t("view.searching"));
});
/** The user says that a part in view is the one to which its labels belong. */
async function confirmPart(part, name = t("confirm.this_part")) {
  if (!specimens.waiting.includes(part)) return;
  toast.show((await connection.ask({ confirm: specimens.isSeveral ? part : true })) || t("confirm.done", { name }));
}

/** Confirm the part that waits for it; of several, the user has to choose. */
function confirmWaiting() {
  const { waiting, names } = specimens;
  if (waiting.length === 1) confirmPart(waiting[0], specimens.isSeveral ? names[waiting[0]] : undefined);
  else if (waiting.length > 1) toast.show(t("confirm.which", { choices: waiting.map((id) => t("confirm.choice", { key: id + 1, name: names[id] })).join(", ") }));
}

find("transports").addEventListener("change", (event) => {
  connection.choose(event.target.value);
  if (player) player.mode = connection.mode;
});
find("freeze").addEventListener("click", freeze);
find("snapshot").addEventListener("click", snapshot);
find("record").addEventListener("click", record);
connectLook(() => stage.measure());
connectKeys({
  c: confirmWaiting, s: snapshot, r: record, g: () => toggle("ghost"), e: () => toggle("edges"), l: () => toggle("labels"),
  Escape: () => (document.body.dataset.side ? sheet.show("") : isolate(null)),
  ArrowRight: () => parts.step(1), ArrowLeft: () => parts.step(-1),
  "+": () => zoom.step(1), "=": () => zoom.step(1), "-": () => zoom.step(-1), 0: () => zoom.reset(),
  " ": freeze,
}, () => Object.fromEntries((specimens.isSeveral ? specimens.waiting : []).map((id) => [id + 1, () => confirmPart(id, specimens.names[id])])), stage.viewport, () => stage.moved());

/** What job/ may use of the page. */
const host = {
  state, style, stage, camera, connection, toast, message, isolate, share,
  get player() { return player; },
  /** Call a function after each "part", "pose", "status", "drawn", "phase" or "isolate". */
  on(name, act) { listeners.set(name, [...(listeners.get(name) ?? []), act]); },
  openSide: (section) => sheet.show(section),
  /** Ask for the serial number of a part; null when the user cancels. */
  askSerial: (part = 0, more = {}) => askSerial({
    frame: () => player?.shown?.frame?.canvas ?? null, seen: () => player?.answer?.parts[part]?.serial ?? "",
    suggestion: state.part ? partsOf(state.part)[part]?.part?.serial : "", ...more,
  }),
};
mountJob(host);

// --- start and end ------------------------------------------------------------------------------

// In the next frame: what the observed elements do with it must not be part of this observation.
const measure = new ResizeObserver(() => requestAnimationFrame(() => {
  const { style: root } = document.documentElement, top = (id) => find(id).getBoundingClientRect().top || innerHeight;
  root.setProperty("--bar", `${find("bar").offsetHeight}px`);
  root.setProperty("--below", `${innerHeight - Math.min(top("actions"), top("card"))}px`);
}));
for (const id of ["bar", "actions", "card"]) measure.observe(find(id));

let wakeLock = null;

async function stayAwake() {
  if (document.visibilityState !== "visible") return;
  wakeLock = await navigator.wakeLock?.request("screen").catch(() => null);
}

document.addEventListener("visibilitychange", stayAwake);
window.addEventListener("pagehide", () => connection.end());
window.addEventListener("pageshow", (event) => { if (event.persisted) location.reload(); });
stayAwake();
connection.hasGhost = stage.hasGhost;
refresh();
connection.run();
