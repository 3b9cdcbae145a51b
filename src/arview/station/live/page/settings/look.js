// The choice of colours and text size in the view section.

const GROUPS = ["theme", "size"];

/** Connect the radio buttons named theme and size; onChange is called after a choice. */
export function connectLook(onChange) {
  const { look, choose } = globalThis.arviewLook;
  for (const name of GROUPS) {
    for (const input of document.querySelectorAll(`input[name="${name}"]`)) {
      input.checked = input.value === look[name];
      input.addEventListener("change", () => {
        choose({ [name]: input.value });
        onChange();
      });
    }
  }
}
