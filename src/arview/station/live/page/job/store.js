// Photos that wait to be sent, kept in the browser's database, so that they survive a reload and an empty battery.

const NAME = "arview", TABLE = "photos";

const done = (request) => new Promise((resolve, reject) => {
  request.onsuccess = () => resolve(request.result);
  request.onerror = () => reject(request.error);
});

/** Open the store; in a browser without a database (private windows of some) photos are kept in memory only. */
export async function openStore() {
  try {
    const opening = indexedDB.open(NAME, 1);
    opening.onupgradeneeded = () => opening.result.createObjectStore(TABLE, { keyPath: "key", autoIncrement: true });
    return new Store(await done(opening));
  } catch {
    return new MemoryStore();
  }
}

class Store {
  isDurable = true;

  constructor(database) {
    this.database = database;
  }

  /** Keep an entry; resolves with its key when it is on the disk. */
  add(entry) {
    return this.#change((table) => table.add(entry));
  }

  update(entry) {
    return this.#change((table) => table.put(entry));
  }

  remove(key) {
    return this.#change((table) => table.delete(key));
  }

  /** All entries, oldest first. */
  all() {
    return done(this.database.transaction(TABLE).objectStore(TABLE).getAll());
  }

  #change(act) {
    return new Promise((resolve, reject) => {
      const transaction = this.database.transaction(TABLE, "readwrite", { durability: "strict" });
      const request = act(transaction.objectStore(TABLE));
      transaction.oncomplete = () => resolve(request.result);
      transaction.onerror = transaction.onabort = () => reject(transaction.error ?? request.error);
    });
  }
}

class MemoryStore {
  isDurable = false;
  #entries = new Map();
  #next = 1;

  async add(entry) {
    const key = this.#next++;
    this.#entries.set(key, { ...entry, key });
    return key;
  }

  async update(entry) {
    this.#entries.set(entry.key, entry);
  }

  async remove(key) {
    this.#entries.delete(key);
  }

  async all() {
    return [...this.#entries.values()];
  }
}
