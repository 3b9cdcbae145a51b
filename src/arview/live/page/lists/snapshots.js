// The snapshots that this device has taken, kept in the browser (IndexedDB), the newest ones only.

const KEPT = 24;

function request(asked) {
  return new Promise((resolve, reject) => {
    asked.addEventListener("success", () => resolve(asked.result));
    asked.addEventListener("error", () => reject(asked.error));
  });
}

async function store(mode) {
  const opening = indexedDB.open("arview", 1);
  opening.addEventListener("upgradeneeded", () => opening.result.createObjectStore("snapshots", { keyPath: "name" }));
  return (await request(opening)).transaction("snapshots", mode).objectStore("snapshots");
}

let here = []; // without IndexedDB, as in private windows, until the page is closed

/** Keep a snapshot. */
export async function keepSnapshot(name, blob) {
  const one = { name, bytes: blob.size, created: new Date().toISOString(), blob };
  here = [one, ...here].slice(0, KEPT);
  try {
    await request((await store("readwrite")).put(one));
    const old = (await snapshots()).slice(KEPT);
    const all = await store("readwrite");
    for (const { name: key } of old) all.delete(key);
  } catch { /* it stays in memory */ }
}

/** The snapshots {name, bytes, created, blob}, the newest first. */
export async function snapshots() {
  let kept = [];
  try {
    kept = await request((await store("readonly")).getAll());
  } catch { /* as above */ }
  const names = new Set(kept.map((one) => one.name));
  return [...kept, ...here.filter((one) => !names.has(one.name))].sort((a, b) => (a.created < b.created ? 1 : -1));
}
