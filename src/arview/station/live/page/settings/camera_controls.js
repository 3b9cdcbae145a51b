// Controls of this device's camera: which one, torch, exposure, focus. Each is shown only where the camera has it.

import { make } from "../icons.js";
import { t } from "../texts/texts.js";

export class CameraControls {
  /**
   * @param box section that shows the controls.
   * @param camera the Camera.
   * @param onRefused called with a text when the camera does not accept a setting.
   */
  constructor(box, camera, onRefused) {
    Object.assign(this, { box, camera, onRefused });
    this.box.hidden = true;
    navigator.mediaDevices?.addEventListener?.("devicechange", () => this.refresh());
  }

  /** Show the controls of the running camera. */
  async refresh() {
    const { track } = this.camera;
    const devices = track ? (await navigator.mediaDevices.enumerateDevices().catch(() => [])).filter((one) => one.kind === "videoinput") : [];
    if (track !== this.camera.track) return; // the camera has changed meanwhile; another call follows
    const can = track?.getCapabilities?.() ?? {}, now = track?.getSettings?.() ?? {};
    const rows = [
      devices.length > 1 ? this.#which(devices, now.deviceId) : null,
      can.torch ? this.#torch() : null,
      isRange(can.exposureCompensation) ? this.#slider("exposure", can.exposureCompensation, now.exposureCompensation ?? 0, (value) => ({ exposureCompensation: value })) : null,
      ...(isRange(can.focusDistance) && can.focusMode?.includes("manual") ? this.#focus(can, now) : []),
    ].filter(Boolean);
    this.box.replaceChildren(make("h3", "", [t("camera.label")]), ...rows);
    this.box.hidden = rows.length === 0;
  }

  #which(devices, current) {
    const options = devices.map(({ deviceId, label }, i) => {
      return make("option", "", [label || t("camera.number", { number: i + 1 })], deviceId === current ? { value: deviceId, selected: "" } : { value: deviceId });
    });
    const select = make("select", "wide", options, { id: "camera-choice" });
    select.addEventListener("change", () => this.camera.choose(select.value));
    return make("label", "row", [make("span", "", [t("camera.which")]), select], { for: "camera-choice" });
  }

  #torch() {
    const button = make("button", "switch", [make("span", "", [t("camera.torch")])], { id: "torch", role: "switch", "aria-checked": "false" });
    button.addEventListener("click", async () => {
      const isOn = button.getAttribute("aria-checked") !== "true";
      if (await this.#apply({ torch: isOn })) button.setAttribute("aria-checked", String(isOn));
    });
    return button;
  }

  #focus(can, now) {
    const slider = this.#slider("focus", can.focusDistance, now.focusDistance ?? can.focusDistance.min, (value) => ({ focusMode: "manual", focusDistance: value }));
    if (!can.focusMode.includes("continuous")) return [slider];
    const isAuto = now.focusMode !== "manual", input = slider.querySelector("input");
    const button = make("button", "switch", [make("span", "", [t("camera.focus_auto")])], { id: "focus-auto", role: "switch", "aria-checked": String(isAuto) });
    input.disabled = isAuto;
    button.addEventListener("click", async () => {
      const wanted = button.getAttribute("aria-checked") !== "true";
      const change = wanted ? { focusMode: "continuous" } : { focusMode: "manual", focusDistance: Number(input.value) };
      if (!(await this.#apply(change))) return;
      button.setAttribute("aria-checked", String(wanted));
      input.disabled = wanted;
    });
    return [button, slider];
  }

  /** A slider with its value. */
  #slider(name, { min, max, step }, value, constraint) {
    const shown = (number) => (name === "exposure" ? t("camera.exposure_value", { value: `${number > 0 ? "+" : ""}${Number(number).toFixed(1)}` }) : Number(number).toFixed(2));
    const output = make("output", "", [shown(value)]);
    const input = make("input", "", [], { type: "range", id: `camera-${name}`, min, max, step: step || (max - min) / 20 });
    input.value = value;
    input.addEventListener("input", () => {
      output.textContent = shown(input.value);
      this.#apply(constraint(Number(input.value)));
    });
    return make("div", "slider-row", [make("label", "slider", [make("span", "", [t(`camera.${name}`)]), output], { for: input.id }), input]);
  }

  async #apply(constraint) {
    try {
      await this.camera.track.applyConstraints({ advanced: [constraint] });
      return true;
    } catch {
      this.onRefused(t("camera.refused"));
      return false;
    }
  }
}

const isRange = (one) => one !== undefined && one.max > one.min;
