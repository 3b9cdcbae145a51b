// Keyboard shortcuts.

const PAN_PX = 60;

/**
 * Connect the shortcuts.
 * @param keys {key: function}, keys as in KeyboardEvent.key, letters in lower case.
 * @param more function that returns further ones for the present state.
 * @param viewport moved by the arrows with shift; onMoved is called then.
 */
export function connectKeys(keys, more, viewport, onMoved) {
  const pans = { ArrowLeft: [PAN_PX, 0], ArrowRight: [-PAN_PX, 0], ArrowUp: [0, PAN_PX], ArrowDown: [0, -PAN_PX] };
  document.addEventListener("keydown", (event) => {
    if (event.ctrlKey || event.metaKey || event.altKey || document.querySelector("dialog[open]")) return;
    const { target, key } = event, isButton = ["BUTTON", "A", "SUMMARY"].includes(target.tagName);
    const isTyping = ["INPUT", "SELECT", "TEXTAREA"].includes(target.tagName);
    if (event.shiftKey && key in pans && !isTyping) {
      event.preventDefault();
      viewport.pan(...pans[key]);
      onMoved();
      return;
    }
    const act = { ...keys, ...more() }[key.length === 1 ? key.toLowerCase() : key];
    if (!act || (isTyping && key !== "Escape") || (isButton && key === " ") || event.repeat) return;
    event.preventDefault();
    act();
  });
}
