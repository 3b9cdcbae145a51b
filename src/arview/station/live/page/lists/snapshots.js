// The snapshots that this device has taken, kept in the browser (IndexedDB), the newest ones only.

const KEPT = 24;

/** Ask the store of snapshots: `act` gets it and returns a request, whose result is returned once all is written. */
function inStore(mode, act) {
  return new Promise((resolve, reject) => {
    const opening = indexedDB.open("arview-snapshots", 1);
    opening.onupgradeneeded = () => opening.result.createObjectStore("snapshots", { keyPath: "name" });
    opening.onerror = () => reject(opening.error);
    opening.onsuccess = () => {
      const database = opening.result, transaction = database.transaction("snapshots", mode);
      const request = act(transaction.objectStore("snapshots"));
      transaction.oncomplete = () => {
        database.close();
        resolve(request.result);
      };
      transaction.onabort = transaction.onerror = () => reject(transaction.error);
    };
  });
}

let here = []; // without IndexedDB, as in private windows, until the page is closed

const byAge = (a, b) => (a.created < b.created ? 1 : -1);

/** Keep a snapshot. */
export async function keepSnapshot(name, blob) {
  const one = { name, bytes: blob.size, created: new Date().toISOString(), blob };
  here = [one, ...here].slice(0, KEPT);
  try {
    await inStore("readwrite", (store) => store.put(one));
    const old = (await snapshots()).slice(KEPT);
    if (old.length) await inStore("readwrite", (store) => old.map(({ name: key }) => store.delete(key)).at(-1));
  } catch (error) {
    console.warn(`the snapshot is kept until the page is closed: ${error}`);
  }
}

/** The snapshots {name, bytes, created, blob}, the newest first. */
export async function snapshots() {
  let kept = [];
  try {
    kept = await inStore("readonly", (store) => store.getAll());
  } catch { /* as in keepSnapshot */ }
  const names = new Set(kept.map((one) => one.name));
  return [...kept, ...here.filter((one) => !names.has(one.name))].sort(byAge);
}
