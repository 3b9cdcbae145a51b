// Sound, vibration and a flash of the frame: the user looks at the part, not at the screen.

let context = null;

/** Sound is allowed after a press only: call it from one. */
export function allowSound() {
  try {
    context ??= new AudioContext();
    context.resume().catch(() => {});
  } catch { /* this browser has no sound */ }
}

function tone(hz, startS, lengthS, loudness) {
  if (context?.state !== "running") return;
  const from = context.currentTime + startS, source = context.createOscillator(), gain = context.createGain();
  source.frequency.value = hz;
  gain.gain.setValueAtTime(loudness, from);
  gain.gain.exponentialRampToValueAtTime(0.001, from + lengthS);
  source.connect(gain).connect(context.destination);
  source.start(from);
  source.stop(from + lengthS);
}

const SIGNALS = {
  taken: { tones: [[1400, 0, 0.05], [2100, 0.05, 0.08]], buzz: [35] },
  enough: { tones: [[880, 0, 0.12], [1320, 0.13, 0.25]], buzz: [40, 60, 40] },
  failed: { tones: [[240, 0, 0.25]], buzz: [120, 60, 120] },
};

/** Give a signal: taken, enough or failed. */
export function signal(name) {
  const { tones, buzz } = SIGNALS[name];
  for (const [hz, startS, lengthS] of tones) tone(hz, startS, lengthS, 0.25);
  navigator.vibrate?.(buzz);
  if (name !== "taken") return;
  document.body.classList.remove("photo-taken");
  requestAnimationFrame(() => document.body.classList.add("photo-taken"));
  setTimeout(() => document.body.classList.remove("photo-taken"), 350);
}
