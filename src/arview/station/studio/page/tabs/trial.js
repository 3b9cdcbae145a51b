// Tab "Trial": is the part found in a picture, a clip, or what the webcam sees now?

import { ask } from "../api.js";
import { icon, make, numberInput, percent } from "../dom.js";

export class TrialTab {
  title = "Trial";

  constructor(store, panel) {
    this.store = store;
    this.file = make("input", { type: "file", id: "trial-file", accept: "image/*,video/*,.heic,.mkv", "aria-label": "Picture or clip", onchange: () => {
      if (this.file.files[0]) this.#send(this.file.files[0], this.file.files[0].name);
      this.file.value = "";
    } });
    this.drop = make("label", { class: "drop", for: "trial-file" }, make("b", {}, "Choose a picture or clip"), make("small", {}, "or drop one here; of a clip the first 60 frames are tried"), this.file);
    this.fov = numberInput({ value: "", min: "5", max: "170", placeholder: "guessed", "data-key": "fov", onValue: () => {} });
    this.video = make("video", { playsInline: true, muted: true, hidden: true, "aria-label": "Webcam" });
    this.webcam = make("button", { class: "wide", type: "button", onclick: () => this.#toggleWebcam() }, "Webcam");
    this.still = make("button", { class: "wide main", type: "button", hidden: true, onclick: () => this.#grab() }, "Try this picture");
    this.result = make("div", { class: "result", role: "status" });
    panel.append(this.drop, make("label", { class: "field" }, make("span", {}, "Field of view °"), this.fov, make("small", {}, "across the wide side; empty: guessed")),
      make("div", { class: "pair" }, this.webcam, this.still), this.video, this.result);
    for (const type of ["dragenter", "dragover"]) this.drop.addEventListener(type, (event) => this.#over(event, true));
    for (const type of ["dragleave", "drop"]) this.drop.addEventListener(type, (event) => this.#over(event, false));
    this.drop.addEventListener("drop", (event) => {
      const file = event.dataTransfer.files[0];
      if (file) this.#send(file, file.name);
    });
  }

  close() {
    this.#stopWebcam();
  }

  #over(event, isOver) {
    event.preventDefault();
    this.drop.classList.toggle("is-over", isOver);
  }

  async #send(body, name) {
    const query = new URLSearchParams({ name });
    if (this.fov.value) query.set("camera", `fov:${this.fov.value}`);
    this.result.replaceChildren(make("p", { class: "facts" }, `${name} is being tried …`));
    const answer = await this.store.during("Trying the part", async () => (await ask(`/api/trial?${query}`, { body })).json());
    if (!answer) {
      this.result.replaceChildren();
      return;
    }
    const isTracked = answer.tracked > 0, picture = make("img", { alt: isTracked ? "The part, drawn where it was found" : "The picture: the part was not found" });
    const large = make("button", { type: "button", class: "enlarge", title: "Large or small", "aria-label": "Show the picture large or small", onclick: () => large.classList.toggle("is-large") }, picture);
    picture.src = `/api/trial.jpg?n=${Date.now()}`;
    const count = answer.frames === 1 ? "" : ` in ${answer.tracked} of ${answer.frames} frames`;
    this.result.replaceChildren(
      make("div", { class: `verdict-box ${isTracked ? "pass" : "fail"}` }, icon(isTracked ? "pass" : "fail"),
        make("div", {}, make("b", { class: "trial-state" }, `${isTracked ? "tracked" : "not found"}${count}`), make("div", {}, isTracked ? `quality ${percent(answer.quality)}${answer.reason ? `; ${answer.reason}` : ""}` : (answer.reason || "no reason is known").replace(/^not found:\s*/, "")))),
      large, this.#presence(answer.components));
  }

  #presence(components) {
    const words = Object.entries(components ?? {}).filter(([, word]) => word !== "present");
    return words.length ? make("p", { class: "facts" }, `Not confirmed as present: ${words.map(([name, word]) => `${name} (${word})`).join(", ")}.`) : "";
  }

  async #toggleWebcam() {
    if (this.stream) {
      this.#stopWebcam();
      return;
    }
    try {
      this.stream = await navigator.mediaDevices.getUserMedia({ video: { width: { ideal: 1920 }, height: { ideal: 1080 } } });
    } catch (error) {
      this.store.tell(`The webcam cannot be used: ${error.message}`);
      return;
    }
    this.video.srcObject = this.stream;
    await this.video.play();
    this.video.hidden = this.still.hidden = false;
    this.webcam.textContent = "Webcam off";
  }

  #stopWebcam() {
    this.stream?.getTracks().forEach((track) => track.stop());
    this.stream = this.video.srcObject = null;
    this.video.hidden = this.still.hidden = true;
    this.webcam.textContent = "Webcam";
  }

  async #grab() {
    const canvas = make("canvas", { width: this.video.videoWidth, height: this.video.videoHeight });
    canvas.getContext("2d").drawImage(this.video, 0, 0);
    const blob = await new Promise((done) => canvas.toBlob(done, "image/jpeg", 0.95));
    await this.#send(blob, "webcam.jpg");
  }
}
