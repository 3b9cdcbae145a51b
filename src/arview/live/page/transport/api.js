// Requests to the server, and its refusals in words.

/** A refusal by the server, or no answer at all (code "offline"). */
export class Refusal extends Error {
  constructor(status, code, message, waitS = 0) {
    super(message);
    Object.assign(this, { status, code, waitS });
  }
}

const TIMEOUT_MS = 12_000;

/** fetch that raises a Refusal for everything but a success. */
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
    throw new Refusal(0, "offline", "the station does not answer");
  }
  if (answer.ok) return answer;
  let said = {};
  try {
    said = await answer.json();
  } catch { /* an error that is not from arview's own code has no words */ }
  throw new Refusal(
    answer.status, said.error ?? "error", said.message ?? `the station answered ${answer.status}`,
    Number(answer.headers.get("Retry-After")) || 0,
  );
}

export const getPart = async () => (await ask("/api/part")).json();
export const getModel = async () => (await ask("/api/model.glb")).arrayBuffer();

const REMEMBERED = "arview-client";

/** Take part; {client, answer}. This page's earlier self, before a reload, leaves. */
export async function join(request, signal) {
  const before = sessionStorage.getItem(REMEMBERED);
  const json = before ? { ...request, replaces: before } : request;
  const joined = await (await ask("/api/clients", { method: "POST", json, signal })).json();
  sessionStorage.setItem(REMEMBERED, joined.client);
  return joined;
}

/** Leave, even while the page is being closed. */
export function leave(client) {
  sessionStorage.removeItem(REMEMBERED);
  ask(`/api/clients/${client}`, { method: "DELETE", keepalive: true }).catch(() => {});
}

/** Ask for something; the client's Status. */
export const control = async (client, request) =>
  (await ask(`/api/clients/${client}/control`, { method: "POST", json: request })).json();

export const getStatus = async (client, signal) => (await ask(`/api/clients/${client}/status`, { signal })).json();
