// A screen that only watches: the annotated picture as motion JPEG, with messages about failures.

import { ask, getPart } from "./transport/api.js";
import { Message, Notices } from "./status.js";
import { t, translate, translated } from "./texts/texts.js";

const REFRESH_MS = 2000;
const film = document.getElementById("film");
const notices = new Notices(document.getElementById("notices")), message = new Message(document.getElementById("message"));

history.replaceState(null, "", location.pathname);
translate();

let isOn = false;

function begin() {
  isOn = true;
  film.src = `/watch.mjpg?${Date.now()}`;
}

film.addEventListener("error", () => { isOn = false; });
film.addEventListener("load", () => message.show(null));

async function refresh() {
  try {
    const part = await getPart();
    if (part.state !== "ready") {
      message.show({ sign: "busy", title: t(part.state === "failed" ? "message.failed" : "message.loading"), text: part.text });
      return;
    }
    document.title = `${part.part.name} ${part.part.serial} · arview`;
    const status = translated(await (await ask("/api/status")).json());
    notices.show(status.notices.filter((one) => one.level !== "info"));
    if (!isOn) begin();
    const { feed } = status;
    if (!feed && part.source === "phone" && status.clients === 0) {
      message.show({ sign: "camera", title: t("message.no_phone"), text: t("message.no_phone.text") });
    } else if (feed && feed.state !== "live") {
      message.show({ sign: "offline", title: t("message.no_picture"), text: feed.text });
    } else {
      message.show(null);
    }
  } catch (error) {
    isOn = false;
    const title = t(error.code === "no_token" ? "message.denied" : "message.lost");
    message.show({ sign: "offline", title, text: error.message });
  }
}

refresh();
setInterval(refresh, REFRESH_MS);
