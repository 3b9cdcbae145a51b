// The start of a job: which part, which serial number; and the jobs there are, to go on with or to open.

import { icon, make } from "../icons.js";
import { partsOf } from "../transport/api.js";
import { t } from "../texts/texts.js";
import { fileOf } from "./api.js";
import { verdictSign } from "./verdicts.js";

/** Name of a part in the part document. */
export const nameOf = (part) => part.name || part.part.name;

/** The number of a job's part among those of the page; 0 where it is not among them. */
export function numberOf(job, document) {
  return Math.max(0, partsOf(document).findIndex((one) => nameOf(one) === job.part_name || one.part?.name === job.part_name));
}

/** The name of a part by the path of its file: that of the folder where all files are called the same. */
function shortName(path) {
  const [folder, file] = ["", ...path.split(/[\\/]/)].slice(-2);
  return file === "part.toml" && folder ? folder : file.replace(/\.toml$/, "");
}

export class StartView {
  #key = "";

  /** @param events {onStart(part, serial), onOpen(id)} */
  constructor(host, events) {
    Object.assign(this, { host, events });
    this.parts = make("select", "", [], { id: "job-part" });
    this.serial = make("input", "", [], { id: "job-serial", type: "text", maxlength: "60", autocomplete: "off", autocapitalize: "characters", spellcheck: "false", enterkeyhint: "go" });
    this.read = make("button", "job-read", [], { type: "button" });
    this.read.hidden = true;
    this.read.addEventListener("click", () => { this.serial.value = this.read.dataset.serial; });
    this.scan = make("button", "job-scan", [icon("align"), t("job.scan")], { type: "button" });
    this.scan.addEventListener("click", () => this.#scan());
    this.go = make("button", "wide primary", [t("job.start")], { type: "submit" });
    this.partLine = make("label", "job-field", [make("span", "", [t("job.part")]), this.parts], { for: "job-part" });
    this.form = make("form", "job-form", [
      this.partLine,
      make("label", "job-field", [make("span", "", [t("job.serial")]), this.serial], { for: "job-serial" }),
      make("div", "job-codes", [this.scan, this.read]),
      this.go,
    ]);
    this.form.addEventListener("submit", (event) => {
      event.preventDefault();
      const serial = this.serial.value.trim();
      if (!serial) {
        this.serial.focus();
        return host.toast.show(t("job.serial_needed"));
      }
      events.onStart(Number(this.parts.value) || 0, serial);
    });
    this.list = make("ul", "job-list");
    this.none = make("p", "job-quiet", [t("job.no_jobs")]);
    this.element = make("div", "job-view", [this.form, make("h3", "", [t("job.jobs")]), this.list, this.none]);
  }

  /** Show the parts of the page. */
  setPart(document) {
    const parts = partsOf(document).filter((one) => one.part);
    this.parts.replaceChildren(...parts.map((one, id) => make("option", "", [nameOf(one)], { value: String(id) })));
    this.partLine.hidden = parts.length < 2;
    const known = parts[0]?.part.serial;
    if (!this.serial.value && known) this.serial.value = known;
  }

  /** Offer the serial number that the tracker read from a code on the part. */
  takePose(pose) {
    const serial = (pose.parts ?? [pose]).map((one) => one.serial).find(Boolean) ?? "";
    if (!serial || this.read.dataset.serial === serial) return;
    this.read.dataset.serial = serial;
    this.read.textContent = t("job.use_read", { serial });
    this.read.hidden = false;
    if (!this.serial.value) this.serial.value = serial;
  }

  /** Show the jobs: GET /api/jobs; null while they are unknown. */
  setJobs(jobs) {
    const key = JSON.stringify(jobs);
    if (key === this.#key) return;
    this.#key = key;
    const firsts = (jobs ?? []).filter((one) => !one.parent);
    this.none.hidden = firsts.length > 0;
    this.list.replaceChildren(...firsts.map((one) => this.#row(one)));
  }

  #row(one) {
    const isDone = one.stage === "done";
    const about = [new Date(one.created).toLocaleString([], { dateStyle: "short", timeStyle: "short" }), t("job.photos", { photos: one.photos })];
    const open = make("button", "job-row", [
      verdictSign(isDone ? one.verdict : null, one.stage),
      make("span", "name", [one.serial]), make("span", "about", [[one.part_name ?? shortName(one.part), ...about].join(", ")]),
      make("span", "more", [t(isDone ? "job.open" : "job.go_on")]),
    ]);
    open.addEventListener("click", () => this.events.onOpen(one.id));
    const links = isDone ? [make("a", "job-link", [t("job.report")], { href: fileOf(one.id, "report.html"), target: "_blank", rel: "noopener" })] : [];
    return make("li", "", [open, ...links]);
  }

  async #scan() {
    const serial = await this.host.askSerial?.(Number(this.parts.value) || 0);
    if (serial) this.serial.value = serial;
  }
}
