// Requests to the server, and its error messages.

/** An error response of the server, or no response at all (code "offline"). */
export class Refusal extends Error {
  constructor(status, code, message) {
    super(message);
    Object.assign(this, { status, code });
  }
}

/** As fetch, but throws a Refusal for everything except success. */
export async function ask(path, { json, body, signal } = {}) {
  const headers = {};
  if (json !== undefined) {
    headers["Content-Type"] = "application/json";
    body = JSON.stringify(json);
  }
  let answer;
  try {
    answer = await fetch(path, { method: body === undefined ? "GET" : "POST", body, headers, signal, cache: "no-store" });
  } catch (error) {
    if (signal?.aborted) throw error;
    throw new Refusal(0, "offline", "The studio does not answer: was it ended in the terminal? Edits can no longer be saved.");
  }
  if (answer.ok) return answer;
  let told = {};
  try {
    told = await answer.json();
  } catch { /* an error that arview did not send has no JSON body */ }
  throw new Refusal(answer.status, told.error ?? "error", told.message ?? `The studio answered with status ${answer.status}.`);
}

export const get = async (path, options) => (await ask(path, options)).json();
export const post = async (path, json = {}) => (await ask(path, { json })).json();
