// The texts of the page: one catalogue for each language, with English for whatever a language lacks. Messages that the
// server makes (reasons of the tracking, notices, errors) are English.

import de from "./de.js";
import en from "./en.js";

const catalogues = { en: { ...en }, de: { ...de } };
const ATTRIBUTES = { text: null, label: "aria-label", title: "title", alt: "alt", placeholder: "placeholder" };

/** The language of the page: the first one of the browser that has a catalogue. */
export const language = chosen(navigator.languages?.length ? navigator.languages : [navigator.language]);

/** The language to use for a list of wanted ones, such as ["de-AT", "en"]. */
export function chosen(wanted) {
  const codes = wanted.map((one) => String(one ?? "").toLowerCase().split("-")[0]);
  return codes.find((code) => code in catalogues) ?? "en";
}

/** Add texts {en: {key: text}, de: …} of another part of the page. */
export function addTexts(more) {
  for (const [code, texts] of Object.entries(more)) Object.assign((catalogues[code] ??= {}), texts);
}

/** The text of a key with its {placeholders} replaced. */
export function t(key, values = {}) {
  const text = catalogues[language][key] ?? catalogues.en[key];
  if (text === undefined) {
    console.error(`no text for ${key}`);
    return key;
  }
  return text.replace(/\{(\w+)\}/g, (whole, name) => (name in values ? String(values[name]) : whole));
}

/** Whether there is a text for this key. */
export const hasText = (key) => key in catalogues.en;

/** Write the texts of elements with data-text, data-label, data-title, data-alt or data-placeholder. */
export function translate(root = document) {
  for (const [name, attribute] of Object.entries(ATTRIBUTES)) {
    for (const element of root.querySelectorAll(`[data-${name}]`)) {
      const text = t(element.dataset[name]);
      if (attribute) element.setAttribute(attribute, text);
      else element.textContent = text;
    }
  }
  document.documentElement.lang = language;
}

/** A duration as minutes and seconds, such as 1:05. */
export const clock = (seconds) => `${Math.floor(seconds / 60)}:${String(Math.floor(seconds % 60)).padStart(2, "0")}`;
