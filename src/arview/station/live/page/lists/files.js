// The section with recordings, snapshots and reports: to open, share or save.

import { icon, make } from "../icons.js";
import { clock, t } from "../texts/texts.js";
import { ask } from "../transport/api.js";
import { canShare, save, share } from "./share.js";
import { snapshots } from "./snapshots.js";

const SIGNS = { pass: "pass", fail: "fail", undecided: "undecided" };

export class Files {
  #isBusy = false;
  #isAskedAgain = false;

  /**
   * @param box element of the section.
   * @param onTrouble called with a text when a file could not be shared.
   */
  constructor(box, onTrouble) {
    Object.assign(this, { box, onTrouble });
  }

  /** Ask for the lists anew and show them. */
  async refresh() {
    this.#isAskedAgain = this.#isBusy;
    if (this.#isBusy) return;
    this.#isBusy = true;
    try {
      const [recordings, jobs, there, kept] = await Promise.all([
        asked("/api/recordings", "recordings"), asked("/api/jobs", "jobs"), asked("/api/snapshots", "snapshots"), snapshots(),
      ]);
      const refresh = make("button", "wide", [t("files.refresh")], { id: "refresh-files" });
      refresh.addEventListener("click", () => this.refresh());
      this.box.replaceChildren(
        ...this.#list("recordings", recordings, (one) => this.#recording(one)),
        ...(there instanceof Error || there.length ? this.#list("station_snapshots", there, (one) => this.#stationSnapshot(one)) : []),
        ...this.#list("snapshots", kept, (one) => this.#snapshot(one)),
        ...this.#list("reports", jobs, (one) => this.#report(one)),
        refresh,
      );
    } finally {
      this.#isBusy = false;
    }
    if (this.#isAskedAgain) await this.refresh(); // something was added meanwhile
  }

  /** Title and rows of a list; an Error instead of a list is told. */
  #list(kind, all, row) {
    const title = make("h3", "", [t(`files.${kind}`)], { id: `${kind}-title` });
    if (all instanceof Error) return [title, make("p", "empty", [t("files.unknown", { reason: all.message })])];
    if (!all.length) return [title, make("p", "empty", [t(`files.no_${kind}`)])];
    return [title, make("ul", "files", all.map(row), { "aria-labelledby": title.id })];
  }

  #recording({ number, name, bytes, seconds, created, is_recovered }) {
    const address = `/api/recordings/${number}`;
    const about = [moment(created), ...(seconds === null ? [] : [clock(seconds)]), size(bytes), ...(is_recovered ? [t("files.recovered")] : [])];
    return this.#row(name, about, null, address, address, "video/mp4");
  }

  #snapshot({ name, bytes, created, blob }) {
    return this.#row(name, [moment(created), size(bytes)], null, () => URL.createObjectURL(blob), blob, "image/png");
  }

  #stationSnapshot({ name, bytes, created }) {
    const address = `/api/snapshots/${encodeURIComponent(name)}`;
    return this.#row(name, [moment(created), size(bytes)], null, address, address, "image/png");
  }

  #report({ id, part, serial, created, stage, verdict, photos, parent }) {
    const about = [moment(created), t(`files.stage.${stage}`), t("files.photos", { count: photos }), ...(parent ? [t("files.recheck")] : [])];
    const address = stage === "done" ? `/api/jobs/${encodeURIComponent(id)}/report.html` : null;
    return this.#row([part, serial].filter(Boolean).join(" "), about, verdict, address, address, "text/html", `${id}.html`);
  }

  /**
   * The row of a file.
   * @param open address, or a function that makes one; null while there is nothing to open.
   * @param source blob or address to save and share.
   */
  #row(name, about, verdict, open, source, type, file = name) {
    const kind = SIGNS[verdict] ?? "none";
    const who = [make("b", "name", [name]), ...(verdict ? [make("span", `count ${kind}`, [icon(kind), t(`verdict.${verdict}`)])] : [])];
    const inside = [make("div", "who", who), make("p", "about", [about.join(" · ")])];
    if (open) inside.push(make("div", "does", this.#buttons(name, open, source, type, file)));
    return make("li", kind, inside);
  }

  #buttons(name, open, source, type, file) {
    const link = make("a", "does-open", [t("files.open")], { target: "_blank", rel: "noopener", "aria-label": t("files.open_named", { name }) });
    if (typeof open === "string") link.href = open;
    else link.addEventListener("click", () => { link.href = open(); });
    link.href ||= "#";
    const button = (act, onClick) => {
      const made = make("button", "", [t(`files.${act}`)], { "aria-label": t(`files.${act}_named`, { name }) });
      made.addEventListener("click", onClick);
      return made;
    };
    const saving = button("save", () => save(source, file));
    const sharing = button("share", () => share(source, file).catch((error) => this.onTrouble(t("files.share_failed", { reason: error.message }))));
    return [link, ...(canShare(type) ? [sharing] : []), saving];
  }
}

/** A list of the station, the newest first; an Error when it does not give it. */
async function asked(path, key) {
  try {
    const all = (await (await ask(path)).json())[key];
    return [...all].sort((a, b) => (a.created < b.created ? 1 : -1));
  } catch (error) {
    return error;
  }
}

/** A moment in the user's own form. */
function moment(iso) {
  const date = new Date(iso);
  return Number.isNaN(date.getTime()) ? iso : date.toLocaleString([], { dateStyle: "short", timeStyle: "short" });
}

/** Bytes as MB or kB. */
const size = (bytes) => (bytes >= 1e6 ? `${(bytes / 1e6).toFixed(1)} MB` : `${Math.max(1, Math.round(bytes / 1e3))} kB`);
