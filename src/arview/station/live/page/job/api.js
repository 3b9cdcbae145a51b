// Requests about jobs: see the HTTP API in arview/station/live/protocol.py.

import { translated } from "../texts/texts.js";
import { ask } from "../transport/api.js";

const at = (id, path = "") => `/api/jobs/${encodeURIComponent(id)}${path}`;
const get = async (path) => translated(await (await ask(path)).json());
const post = async (path, json) => translated(await (await ask(path, { method: "POST", json })).json());

/** Addresses of a job's files, for links and pictures. */
export const fileOf = (id, name) => at(id, `/${name.split("/").map(encodeURIComponent).join("/")}`);

export const listJobs = async () => (await get("/api/jobs")).jobs;
export const openJob = (part, serial) => post("/api/jobs", { part, serial });
export const getJob = (id) => get(at(id));
export const getCells = (id) => get(at(id, "/capture"));
export const reopenJob = (id) => post(at(id, "/reopen"), {});
/** Take a photo back; `why` is "unwanted" or "blurred". Returns the job without it. */
export const takeBack = async (id, name, why) => translated(await (await ask(at(id, `/photos/${encodeURIComponent(name)}?why=${why}`), { method: "DELETE" })).json());
export const endJob = (id) => post(at(id, "/end"), {});
export const recheckJob = (id, components) => post(at(id, "/recheck"), { components });
export const takeAtStation = (id, client, purpose = "measure") => post(at(id, "/take"), { client, purpose });
export const decide = (id, decision) => post(at(id, "/decisions"), decision);
export const tick = (id, one) => post(at(id, "/ticks"), one);
export const sign = (id, by, note) => post(at(id, "/sign"), { by, note });

export const beginUpload = (id, about) => post(at(id, "/uploads"), about);
export const getOffset = async (id, upload) => (await get(at(id, `/uploads/${encodeURIComponent(upload)}`))).offset;
export const sendPiece = async (id, upload, offset, piece) => (await ask(at(id, `/uploads/${encodeURIComponent(upload)}?offset=${offset}`), {
  method: "PATCH", body: piece, headers: { "Content-Type": "application/octet-stream" },
})).json();
