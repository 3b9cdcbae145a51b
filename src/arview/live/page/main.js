// The page: connects camera, connection, picture and controls.

import { Camera, quarterTurns } from "./camera.js";
import { Connection } from "./transport/connection.js";
import { icon } from "./icons.js";
import { PartLists, tally } from "./parts.js";
import { Player } from "./player.js";
import { Specimens, reasonOf, summaryOf } from "./specimens.js";
import { Stage } from "./scene/stage.js";
import { partsOf } from "./transport/api.js";
import { Message, Notices, StatusBar, Toast } from "./status.js";

const FIGURES_EVERY_MS = 500, STYLE_DELAY_MS = 150;
const find = (id) => document.getElementById(id);

history.replaceState(null, "", location.pathname); // the token stays out of bookmarks and shared links
for (const sign of document.querySelectorAll("[data-icon]")) sign.append(icon(sign.dataset.icon));

const style = { ghost: true, edges: "visible", labels: true, opacity: 0.42, only: null, only_part: 0, status: false };
const state = { phase: { name: "loading", text: "" }, part: null, status: null, trouble: "", latencies: [], isRecording: false };

let player = null, isDrawAsked = false;

const bar = new StatusBar({
  icon: find("state-icon"), word: find("state-name"), why: find("state-why"), quality: find("quality"),
  meter: find("quality-meter"), latency: find("latency"), age: find("age"), body: document.body,
});
const notices = new Notices(find("notices")), message = new Message(find("message")), toast = new Toast(find("toast"));
const parts = new PartLists(find("panels"), find("card"), isolate);
const specimens = new Specimens({ list: find("specimens"), confirms: find("confirms"), confirm: find("confirm") }, confirmPart);
const stage = new Stage({
  stage: find("stage"), canvas: find("picture"), leaders: find("leaders"), labels: find("labels"),
  obstacles: [find("bar"), find("notices"), find("actions"), find("card"), find("side")],
}, style, isolate, () => requestDraw());
const camera = new Camera(find("camera"), takeCameraFrame, (trouble) => {
  state.trouble = trouble;
  refresh();
});
const connection = new Connection(find("remote"), {
  onPhase(phase) {
    state.phase = phase;
    if (phase.name !== "connected") player?.reset();
    refresh();
  },
  onPart(part) {
    state.part = part;
    player ??= new Player(part.source === "phone");
    document.body.dataset.source = part.source;
    const all = partsOf(part);
    document.title = `${titleOf(all)} · arview`;
    parts.setParts(all);
    specimens.setParts(all);
    find("open-parts").querySelector(".badge")?.remove();
    const bad = tally(all.flatMap((one) => one.components)).find((one) => one.classList.contains("fail") || one.classList.contains("undecided"));
    if (bad) {
      const badge = document.createElement("span");
      badge.className = `badge ${bad.classList[1]}`;
      badge.append(icon(bad.classList[1]), bad.textContent.split(" ")[0]);
      find("open-parts").append(badge);
    }
    stage.setPart(part);
    if (style.only && !all[style.only_part]?.components.some((one) => one.name === style.only)) isolate(null);
    if (part.source === "phone" && !camera.isOn && !state.trouble) camera.start(part.wanted);
    requestDraw();
  },
  async onModels(buffers, part) {
    await stage.setModels(buffers, part);
  },
  onOpen() {
    player.mode = connection.mode;
    sendStyle();
    if (connection.hasFallenBack) toast.show("This network blocks WebRTC: pictures are sent one by one");
  },
  onPose(pose) {
    player.takePose(pose, performance.now());
    requestDraw();
  },
  onStatus(status) {
    const before = state.status?.recording.finished ?? status.recording.finished;
    state.status = status;
    if (status.mode) player.mode = status.mode;
    const finished = status.recording.finished.filter((number) => !before.includes(number));
    if (finished.length && state.isRecording) offerRecording(finished.at(-1));
    if (!status.recording.is_on && finished.length) state.isRecording = false;
    refresh();
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
}

// --- status and figures ------------------------------------------------------------------------------

function refreshState(shown = player?.shown) {
  const { phase, trouble, status, part } = state;
  const nowMs = performance.now();
  const isLive = !player?.isFrozen && phase.name === "connected" && player.isAnswered(nowMs);
  specimens.show(isLive ? shown?.pose ?? player.answer : null);
  if (player?.isFrozen) {
    const ago = Math.round((Date.now() - player.frozenAt) / 1000);
    return bar.show("frozen", `picture taken ${ago < 2 ? "just now" : `${ago} s ago`}; press Resume to continue`);
  }
  if (phase.name !== "connected") return bar.show(phase.name, retryText(phase));
  if (part?.source === "phone" && trouble) return bar.show("trouble", trouble);
  if (!player.isAnswered(nowMs)) {
    const words = status?.feed?.text || (camera.isOn || part?.source !== "phone" ? "for a response of the station" : "for the camera");
    return bar.show("waiting", words);
  }
  const answer = shown?.pose ?? player.answer;
  if (answer.guide_cam_from_model && !answer.cam_from_model) {
    return bar.show("align", "align the part with the yellow outline");
  }
  if (specimens.isSeveral && answer.parts.length > 1) return bar.show(...summaryOf(answer.parts, specimens.names));
  bar.show(answer.state, reasonOf(answer));
}

const retryText = ({ text, inS }) => (inS ? `${text}. Trying again${inS >= 2 ? ` every ${Math.round(inS)} s` : "…"}` : text);

function refresh() {
  if (player) refreshState();
  else bar.show(state.phase.name, retryText(state.phase));
  const { phase, trouble, part, status } = state;
  const shown = [...(status?.notices ?? [])];
  if (status?.feed && ["reconnecting", "frozen"].includes(status.feed.state) && !shown.some((one) => one.code.startsWith("source_"))) {
    shown.push({ level: "error", text: status.feed.text });
  }
  if (part?.inspection?.note) shown.push({ level: "warning", text: part.inspection.note });
  if (!stage.hasGhost) shown.push({ level: "warning", text: "this browser has no WebGL 2: the station draws the overlay" });
  notices.show(shown.filter((one) => one.level !== "info"));
  message.show(blocking(phase, trouble, part));
  const { recording } = status ?? {};
  setPressed("record", Boolean(recording?.is_on), recording?.is_on ? "stop" : "record", recording?.is_on ? clock(recording.seconds) : "Record");
  const link = connection.link;
  find("link-state").textContent = link
    ? [`Connected by ${link.kind === "jpeg" ? "JPEG over HTTP" : "WebRTC"}, ${player.mode === "video" ? "annotated video" : "poses"}`,
      status?.feed ? `${status.feed.tracked_fps.toFixed(0)} of ${status.feed.received_fps.toFixed(0)} pictures per second tracked` : "",
      link.rttMs === null ? "" : `network ${link.rttMs.toFixed(0)} ms`].filter(Boolean).join("; ")
    : "Not connected";
}

/** The message about what has to be resolved before the page can show anything, or null. */
function blocking(phase, trouble, part) {
  if (phase.name === "busy") {
    return { sign: "busy", title: "Busy", text: `${phase.text}. This page continues as soon as there is room.`, button: "Try now", onPress: () => connection.retryNow() };
  }
  if (phase.name === "denied") {
    return { sign: "offline", title: "This link is no longer valid", text: `${phase.text}.`, button: "Try again", onPress: () => location.reload() };
  }
  if (phase.name === "retrying") {
    return { sign: "offline", title: "Connection lost, retrying", text: `${phase.text}.`, button: "Try now", onPress: () => connection.retryNow() };
  }
  if (phase.name === "loading" && phase.text) return { sign: "busy", title: "Loading", text: phase.text, button: "" };
  if (part?.source === "phone" && trouble) {
    return { sign: "camera", title: "No camera", text: trouble, button: "Try again", onPress: () => camera.start(part.wanted) };
  }
  return null;
}

setInterval(() => {
  const nowMs = performance.now();
  state.latencies = state.latencies.filter((one) => nowMs - one.atMs < 2000);
  const sorted = state.latencies.map((one) => one.ms).sort((a, b) => a - b);
  const pose = player?.shown?.pose;
  bar.figures({
    quality: pose?.isPosed ? Math.min(...pose.parts.filter((one) => one.cam_from_model).map((one) => one.quality)) : pose?.quality ?? null,
    latencyMs: sorted.length ? sorted[sorted.length >> 1] : null,
    ageMs: drawn.frame ? nowMs - drawn.takenMs : null,
  });
  requestDraw(); // removes the overlay when no poses arrive
  refresh();
}, FIGURES_EVERY_MS);

// --- controls ---------------------------------------------------------------------------------------

function isolate(name, part = 0) {
  Object.assign(style, { only: name, only_part: name ? part : 0 });
  parts.show(name, part);
  changeStyle();
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

const clock = (seconds) => `${Math.floor(seconds / 60)}:${String(Math.floor(seconds % 60)).padStart(2, "0")}`;

function freeze() {
  if (!player?.shown?.frame) return;
  player.isFrozen = !player.isFrozen;
  player.frozenAt = Date.now() - (performance.now() - player.shown.frame.takenMs);
  document.body.classList.toggle("is-frozen", player.isFrozen);
  setPressed("freeze", player.isFrozen, player.isFrozen ? "play" : "pause", player.isFrozen ? "Resume" : "Freeze");
  connection.ask({ hold: player.isFrozen ? player.shown.frame.id : null });
  requestDraw();
}

async function snapshot() {
  const { link } = connection, frame = player?.shown?.frame;
  if (!link || !frame) return toast.show("There is no picture yet");
  try {
    clearTimeout(styleTimer);
    await connection.ask({ hold: frame.id, style });
    const answer = await fetch(`/api/clients/${link.client}/snapshot.png?id=${frame.id}`, { cache: "no-store" });
    if (!answer.ok) throw new Error((await answer.json()).message);
    const moment = new Date().toISOString().slice(0, 19).replaceAll(":", "");
    const file = [titleOf(partsOf(state.part)).replaceAll(", ", "_").replaceAll(" ", "_"), moment].filter(Boolean).join("_").replace(/[^\w.-]+/g, "-");
    save(await answer.blob(), `${file}.png`);
    toast.show("Snapshot saved, with its measurements inside");
  } catch (error) {
    toast.show(`No snapshot: ${error.message}`);
  } finally {
    if (!player.isFrozen) connection.ask({ hold: null });
  }
}

/** Names and serial numbers of the parts. */
function titleOf(all) {
  return all.map(({ part, inspection, name }) => [name || part.name, inspection?.serial || part.serial].filter(Boolean).join(" ")).join(", ");
}

function save(blob, name) {
  const link = document.createElement("a");
  link.href = URL.createObjectURL(blob);
  link.download = name;
  link.click();
  setTimeout(() => URL.revokeObjectURL(link.href), 60_000);
}

async function record() {
  const isOn = state.status?.recording.is_on;
  if (!isOn) state.isRecording = true;
  const refusal = await connection.ask({ record: !isOn });
  if (refusal) toast.show(`No recording: ${refusal}`);
}

function offerRecording(number) {
  toast.show("Recording finished", { href: `/api/recordings/${number}`, text: "Save it", download: "" });
}

/** Open a section of the side sheet, or close it. */
function openSide(section) {
  const body = document.body, isOpen = body.dataset.side === section;
  body.dataset.side = isOpen || !section ? "" : section;
  find("open-parts").setAttribute("aria-expanded", String(body.dataset.side === "parts"));
  find("open-view").setAttribute("aria-expanded", String(body.dataset.side === "view"));
  if (body.dataset.side) find("close-side").focus({ preventScroll: true });
  stage.measure();
}

function toggle(key) {
  if (key === "edges") style.edges = style.edges === "none" ? "visible" : "none";
  else style[key] = !style[key];
  find(`show-${key}`).setAttribute("aria-checked", String(key === "edges" ? style.edges !== "none" : style[key]));
  changeStyle();
}

for (const key of ["ghost", "edges", "labels"]) find(`show-${key}`).addEventListener("click", () => toggle(key));
find("opacity").addEventListener("input", (event) => {
  style.opacity = Number(event.target.value);
  find("opacity-text").textContent = `${Math.round(100 * style.opacity)} %`;
  changeStyle();
});
find("search-again").addEventListener("click", async () => {
  toast.show((await connection.ask({ reset: true })) || "Searching for the part again");
});
/** The user says that a part in view is the one to which its labels belong. */
async function confirmPart(part, name = "this part") {
  if (!specimens.waiting.includes(part)) return;
  toast.show((await connection.ask({ confirm: specimens.isSeveral ? part : true })) || `Confirmed: the labels belong to ${name}`);
}

/** Confirm the part that waits for it; of several, the user has to choose. */
function confirmWaiting() {
  const { waiting, names } = specimens;
  if (waiting.length === 1) confirmPart(waiting[0], specimens.isSeveral ? names[waiting[0]] : undefined);
  else if (waiting.length > 1) toast.show(`Which one? Press ${waiting.map((id) => `${id + 1} for ${names[id]}`).join(", ")}`);
}

find("transports").addEventListener("change", (event) => {
  connection.choose(event.target.value);
  if (player) player.mode = connection.mode;
});
find("freeze").addEventListener("click", freeze);
find("snapshot").addEventListener("click", snapshot);
find("record").addEventListener("click", record);
find("open-parts").addEventListener("click", () => openSide("parts"));
find("open-view").addEventListener("click", () => openSide("view"));
find("close-side").addEventListener("click", () => openSide(""));

document.addEventListener("keydown", (event) => {
  if (event.ctrlKey || event.metaKey || event.altKey) return;
  const isTyping = ["INPUT", "SELECT"].includes(event.target.tagName), isButton = event.target.tagName === "BUTTON";
  const keys = {
    c: confirmWaiting, s: snapshot, r: record, g: () => toggle("ghost"), e: () => toggle("edges"), l: () => toggle("labels"),
    Escape: () => (document.body.dataset.side ? openSide("") : isolate(null)),
    ArrowRight: () => parts.step(1), ArrowLeft: () => parts.step(-1),
    " ": freeze,
  };
  for (const id of specimens.waiting) if (specimens.isSeveral) keys[id + 1] = () => confirmPart(id, specimens.names[id]);
  const act = keys[event.key.length === 1 ? event.key.toLowerCase() : event.key];
  if (!act || (isTyping && event.key !== "Escape") || (isButton && event.key === " ") || event.repeat) return;
  event.preventDefault();
  act();
});

// --- start and end ------------------------------------------------------------------------------

new ResizeObserver(() => {
  document.documentElement.style.setProperty("--bar", `${find("bar").offsetHeight}px`);
}).observe(find("bar"));

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
