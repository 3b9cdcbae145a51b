// Requests to the server, and its error messages.

import "../texts/station.js";
import { errorText, t, translated } from "../texts/texts.js";

/** An error response of the server, or no response at all (code "offline"). */
export class Refusal extends Error {
  constructor(status, code, message, waitS = 0) {
    super(message);
    Object.assign(this, { status, code, waitS });
  }
}

const TIMEOUT_MS = 12_000;

/** As fetch, but throws a Refusal for everything except success. */
export async function ask(path, { method = "GET", json, body, headers = {}, keepalive = false, signal } = {}) {
  const all = { ...headers };
  if (json !== undefined) {
    all["Content-Type"] = "application/json";
    body = JSON.stringify(json);
  }
  let answer;
  try {
    const limit = AbortSignal.timeout?.(TIMEOUT_MS);
    const both = signal && limit && AbortSignal.any ? AbortSignal.any([signal, limit]) : signal ?? limit;
    answer = await fetch(path, {
      method, body, keepalive, headers: all, credentials: "same-origin", cache: "no-store", signal: both,
    });
  } catch (error) {
    if (signal?.aborted) throw error;
    throw new Refusal(0, "offline", t("link.silent"));
  }
  if (answer.ok) return answer;
  let document = {};
  try {
    document = await answer.json();
  } catch { /* an error that arview did not send has no JSON body */ }
  throw new Refusal(
    answer.status, document.error ?? "error", errorText(document) ?? t("link.status", { status: answer.status }),
    Number(answer.headers.get("Retry-After")) || 0,
  );
}

/** The parts; of a client that is in a job, with the numbers of that job. */
export const getPart = async (client = null) => translated(await (await ask(client ? `/api/part?client=${client}` : "/api/part")).json());
export const getModel = async (id) => (await ask(`/api/model.glb?part=${id}`)).arrayBuffer();

/** The parts of a *Part* or *Pose* document: their list, or the document itself where there is only one. */
export const partsOf = (document) => document.parts ?? [{ ...document, id: 0 }];

const CLIENT_KEY = "arview-client";

/** Join; returns {client, answer}. The client of this page before a reload leaves. */
export async function join(request, signal) {
  const previous = sessionStorage.getItem(CLIENT_KEY);
  const json = previous ? { ...request, replaces: previous } : request;
  const joined = await (await ask("/api/clients", { method: "POST", json, signal })).json();
  sessionStorage.setItem(CLIENT_KEY, joined.client);
  return joined;
}

/** Leave, even while the page is being closed. */
export function leave(client) {
  sessionStorage.removeItem(CLIENT_KEY);
  ask(`/api/clients/${client}`, { method: "DELETE", keepalive: true }).catch(() => {});
}

/** Send a Control request; returns the Status of the client. */
export const control = async (client, request) =>
  translated(await (await ask(`/api/clients/${client}/control`, { method: "POST", json: request })).json());

export const getStatus = async (client, signal) => translated(await (await ask(`/api/clients/${client}/status`, { signal })).json());
