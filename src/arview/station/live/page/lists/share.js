// Opening, saving and sharing files: with the device's own share sheet where the browser has one, else as a download.

import { errorText } from "../texts/texts.js";

/** Whether this browser can share a file of this type. */
export function canShare(type) {
  try {
    return Boolean(navigator.canShare?.({ files: [new File([new Uint8Array(1)], "a.bin", { type })] }));
  } catch {
    return false;
  }
}

/** Download a blob, or what an address of the station gives. */
export function save(source, name) {
  const link = document.createElement("a"), isBlob = source instanceof Blob;
  link.href = isBlob ? URL.createObjectURL(source) : source;
  link.download = name;
  link.click();
  if (isBlob) setTimeout(() => URL.revokeObjectURL(link.href), 60_000);
}

/**
 * Share a blob, or what an address of the station gives, under a name; it is downloaded where the browser cannot share it.
 * @returns whether it was shared. Throws an Error when the station does not give it; a user who closes the share sheet is no error.
 */
export async function share(source, name) {
  const blob = source instanceof Blob ? source : await fetched(source);
  const file = new File([blob], name, { type: blob.type });
  if (!navigator.canShare?.({ files: [file] })) {
    save(blob, name);
    return false;
  }
  try {
    await navigator.share({ files: [file], title: name });
  } catch (error) {
    if (error.name === "AbortError") return false;
    save(blob, name); // the press may be too long ago after a long download
    return false;
  }
  return true;
}

async function fetched(address) {
  const answer = await fetch(address, { credentials: "same-origin", cache: "no-store" });
  if (!answer.ok) throw new Error(errorText(await answer.json().catch(() => ({}))) ?? String(answer.status));
  return answer.blob();
}
