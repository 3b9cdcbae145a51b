// The texts of the page: one catalogue for each language, with English for whatever a language lacks. Sentences of the
// server arrive in English, with key and values (`messages` in the protocol) for the other languages.

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

/** Numbers in a text with the decimal sign of the language. */
export const decimal = (text) => (language === "de" ? text.replace(/(?<![\d.])(\d+)\.(\d+)(?![\d.])/g, "$1,$2") : text);

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
  return text.replace(/\{(\w+)\}/g, (whole, name) => (name in values ? inWords(values[name]) : whole));
}

/** A value of a text: another text {key, values}, a list of them, or a name or number. */
function inWords(value) {
  if (Array.isArray(value)) return value.map(inWords).join(", ");
  return value?.key ? t(value.key, value.values) : NUMBER.test(value) ? decimal(String(value)) : String(value);
}

const NUMBER = /^[-−+≈]? ?\d+\.\d+( ± \d+\.\d+)?( mm)?$/; // a value that is a number, not a name
const SAID = new Set(["text", "reason", "remark", "title", "value", "word", "notes", "value_text", "mismatches", "faults", "lacking", "steps", "place", "how", "note"]);
const NUMBERS = new Set(["value", "value_text", "detail_text"]); // texts of numbers, beside words in the language
const OF_PEOPLE = new Set(["decisions", "signed", "record", "messages"]); // what people wrote stays as it is

/** A document of the server with its sentences in the language of the page; see `messages` in the protocol. */
export function translated(document) {
  if (language === "en" || document === null || typeof document !== "object") return document;
  return inLanguage(document, document.messages ?? {});
}

function inLanguage(value, messages) {
  if (Array.isArray(value)) return typeof value[0] === "object" ? value.map((one) => inLanguage(one, messages)) : value;
  if (value === null || typeof value !== "object") return value;
  const known = value.messages ? { ...messages, ...value.messages } : messages, made = {};
  for (const [key, one] of Object.entries(value)) {
    if (OF_PEOPLE.has(key)) made[key] = one;
    else if (SAID.has(key)) made[key] = Array.isArray(one) ? one.map((text) => sentence(text, known)) : typeof one === "string" ? sentence(one, known) : inLanguage(one, known);
    else made[key] = inLanguage(one, known);
    if (NUMBERS.has(key) && typeof made[key] === "string") made[key] = decimal(made[key]);
  }
  if (typeof value.completeness === "string") made.completeness_text = sentence(value.completeness, known);
  const isUnknown = typeof value.text === "string" && value.text !== "" && made.text === value.text;
  // A notice has a sentence for its code; the state of a job has its stage, and its text is kept as it came.
  if (isUnknown && typeof value.code === "string" && hasText(`code.${value.code}`)) made.text = t(`code.${value.code}`);
  if (isUnknown && value.kind === "station" && hasText(`code.source_${value.state}`)) made.text = t(`code.source_${value.state}`);
  if (isUnknown && typeof value.stage === "string") Object.assign(made, { text: "", original: value.text });
  return made;
}

/** A sentence of the server, or several that "; " divides. */
function sentence(text, messages) {
  const said = (one) => (messages[one]?.key in catalogues[language] ? inWords(messages[one]) : one);
  return messages[text] ? said(text) : text.split("; ").map(said).join("; ");
}

/** The message of an error {error: code, message} of the server. */
export function errorText({ error, message }) {
  return language !== "en" && hasText(`error.${error}`) ? t(`error.${error}`) : message;
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
