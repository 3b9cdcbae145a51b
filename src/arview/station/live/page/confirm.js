// Questions that are answered by one of some buttons, in a dialog at the lower edge.

import { make } from "./icons.js";

/**
 * Ask; nothing is done by Escape, or by Enter alone: the focus begins on the last answer.
 * @param question {title, text, picture: address of one, or ""}
 * @param answers [{text, value, classes}], the last of which changes nothing.
 * @returns the value of the answer; that of the last one after Escape.
 */
export async function choice({ title, text = "", picture = "" }, answers) {
  const buttons = answers.map(({ text: words, classes = "" }) => make("button", `wide ${classes}`, [words], { type: "button" }));
  const dialog = make("dialog", "dialog", [
    make("h2", "", [title], { id: "confirm-title" }), ...(text ? [make("p", "text", [text], { id: "confirm-text" })] : []),
    ...(picture ? [make("img", "", [], { src: picture, alt: title })] : []), ...buttons,
  ], { role: "alertdialog", "aria-labelledby": "confirm-title", ...(text ? { "aria-describedby": "confirm-text" } : {}) });
  document.body.append(dialog);
  const opener = document.activeElement;
  const answer = await new Promise((resolve) => {
    for (const [index, button] of buttons.entries()) button.addEventListener("click", () => resolve(answers[index].value));
    dialog.addEventListener("cancel", () => resolve(answers.at(-1).value));
    dialog.showModal();
    buttons.at(-1).focus();
  });
  dialog.close();
  dialog.remove();
  opener?.focus?.({ preventScroll: true });
  return answer;
}

/** Whether the user confirms. */
export const confirmed = ({ title, text, yes, no }) => choice({ title, text }, [{ text: yes, value: true, classes: "danger" }, { text: no, value: false }]);
