// The section with the devices that are paired with the station: when each was seen last, and taking its access away.

import { confirmed } from "../confirm.js";
import { icon, make } from "../icons.js";
import { ageText } from "../parts.js";
import { t } from "../texts/texts.js";
import { ask } from "../transport/api.js";

export class Devices {
  #isBusy = false;

  /**
   * @param box element of the section.
   * @param onTell called with a text when a device was revoked, or could not be.
   */
  constructor(box, onTell) {
    Object.assign(this, { box, onTell });
  }

  /** Ask for the list anew and show it. */
  async refresh() {
    if (this.#isBusy) return;
    this.#isBusy = true;
    try {
      this.#show((await (await ask("/api/devices")).json()).devices);
    } catch (error) {
      if (error.code === undefined) throw error;
      this.#show(error);
    } finally {
      this.#isBusy = false;
    }
  }

  #show(devices) {
    const refresh = make("button", "wide", [t("devices.refresh")], { id: "refresh-devices" });
    refresh.addEventListener("click", () => this.refresh());
    const isKnown = Array.isArray(devices);
    const text = !isKnown ? t("devices.unknown", { reason: devices.message }) : t(devices.length ? "devices.text" : "devices.none");
    const about = make("p", isKnown && devices.length ? "text" : "empty", [text]);
    const list = isKnown && devices.length ? [make("ul", "files devices", devices.map((one) => this.#row(one)), { "aria-labelledby": "devices-title" })] : [];
    const hadFocus = this.box.contains(document.activeElement);
    this.box.replaceChildren(about, ...list, refresh);
    if (hadFocus) refresh.focus({ preventScroll: true });
  }

  #row({ name, created, last_used: lastUsed, is_this: isThis }) {
    const revoke = make("button", "", [t("devices.revoke")], { "aria-label": t("devices.revoke_named", { name }) });
    revoke.addEventListener("click", () => this.#revoke(name, isThis));
    const mark = isThis ? [make("span", "count this", [icon("tracked"), t("devices.this")])] : [];
    const seen = t("devices.seen", { age: ageText(Math.max(0, (Date.now() - Date.parse(lastUsed)) / 1000)) });
    const paired = t("devices.paired", { date: new Date(created).toLocaleDateString([], { dateStyle: "medium" }) });
    return make("li", isThis ? "is-this" : "", [
      make("div", "who", [make("b", "name", [name]), ...mark]),
      make("p", "about", [`${seen} · ${paired}`]),
      make("div", "does", [revoke]),
    ], isThis ? { "aria-current": "true" } : {});
  }

  async #revoke(name, isThis) {
    const isSure = await confirmed({
      title: t("devices.revoke_title", { name }), text: t(isThis ? "devices.revoke_this" : "devices.revoke_text"),
      yes: t("devices.revoke_sure"), no: t("devices.keep"),
    });
    if (!isSure) return;
    try {
      await ask(`/api/devices/${encodeURIComponent(name)}`, { method: "DELETE" });
      this.onTell(t("devices.revoked", { name }));
    } catch (error) {
      if (error.code === undefined) throw error;
      this.onTell(t("devices.not_revoked", { name, reason: error.message }));
    }
    await this.refresh();
  }
}
