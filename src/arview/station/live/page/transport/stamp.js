// The stamp: a strip of black and white cells below a picture that encodes the id and size of the frame.
// The layout is that of src/arview/station/live/stream/stamp.py: 20 bits id, 13 width, 13 height, 2 quarter turns, 16 CRC.

export const FRAME_IDS = 1 << 20;
const CELLS = 32, ROWS = 2;

/** Height of the strip below a picture of this width, rows. */
export const stripHeight = (width) => 2 * Math.ceil(width / 64);

/** Whether frame id `a` is newer than `b`; ids wrap around. */
export const isNewer = (a, b) => a !== b && ((a - b) & (FRAME_IDS - 1)) < FRAME_IDS / 2;

/** CRC-16/CCITT-FALSE of bytes. */
export function crc16(bytes) {
  let crc = 0xffff;
  for (const byte of bytes) {
    crc ^= byte << 8;
    for (let bit = 0; bit < 8; bit++) crc = (crc & 0x8000 ? (crc << 1) ^ 0x1021 : crc << 1) & 0xffff;
  }
  return crc;
}

/** The 64 bits of a stamp {id, width, height, turns}, row after row. */
export function stampBits({ id, width, height, turns }) {
  // 48 bits fit into a number exactly, but bitwise operators are limited to 32 bits.
  let value = ((id * 2 ** 13 + width) * 2 ** 13 + height) * 4 + turns;
  const bytes = new Uint8Array(8);
  for (let i = 5; i >= 0; i--, value = Math.floor(value / 256)) bytes[i] = value % 256;
  const crc = crc16(bytes.subarray(0, 6));
  bytes[6] = crc >> 8;
  bytes[7] = crc & 255;
  return Array.from({ length: 64 }, (_, i) => (bytes[i >> 3] >> (7 - (i & 7))) & 1);
}

/** Draw the strip of a stamp below the picture of a canvas. */
export function drawStrip(context, stamp) {
  const { width, height } = stamp, rows = stripHeight(width);
  context.fillStyle = "#000";
  context.fillRect(0, height, width, rows);
  context.fillStyle = "#fff";
  stampBits(stamp).forEach((bit, i) => {
    if (!bit) return;
    const cell = i % CELLS, row = Math.floor(i / CELLS);
    const left = Math.ceil((cell * width) / CELLS), right = Math.ceil(((cell + 1) * width) / CELLS);
    context.fillRect(left, height + (row * rows) / ROWS, right - left, rows / ROWS);
  });
}

const SAMPLED_PX = 4;
let reader = null;

/** The stamp {id, width, height, turns} of a received frame (a video, canvas or bitmap); null when it cannot be read. */
export function readStamp(source, width, height) {
  if (!reader) {
    const canvas = document.createElement("canvas");
    canvas.width = CELLS * SAMPLED_PX;
    canvas.height = ROWS * SAMPLED_PX;
    reader = canvas.getContext("2d", { willReadFrequently: true });
  }
  const { canvas } = reader, rows = stripHeight(width);
  reader.drawImage(source, 0, height - rows, width, rows, 0, 0, canvas.width, canvas.height);
  const pixels = reader.getImageData(0, 0, canvas.width, canvas.height).data;
  const means = [];
  for (let row = 0; row < ROWS; row++) {
    for (let cell = 0; cell < CELLS; cell++) {
      let sum = 0;
      for (let v = 1; v < SAMPLED_PX - 1; v++) {
        for (let u = 1; u < SAMPLED_PX - 1; u++) {
          sum += pixels[4 * ((row * SAMPLED_PX + v) * canvas.width + cell * SAMPLED_PX + u) + 1];
        }
      }
      means.push(sum);
    }
  }
  const threshold = 0.5 * (Math.min(...means) + Math.max(...means));
  const bytes = new Uint8Array(8);
  means.forEach((mean, i) => { if (mean > threshold) bytes[i >> 3] |= 128 >> (i & 7); });
  if (crc16(bytes.subarray(0, 6)) !== bytes[6] * 256 + bytes[7]) return null;
  const high = bytes[0] * 2 ** 16 + bytes[1] * 256 + bytes[2], low = bytes[3] * 2 ** 16 + bytes[4] * 256 + bytes[5];
  const stamp = {
    id: Math.floor(high / 16),
    width: ((high & 15) << 9) | (low >> 15),
    height: (low >> 2) & 0x1fff,
    turns: low & 3,
  };
  return stamp.width === width && stamp.height + rows === height ? stamp : null;
}
