// Takes a photo at the full resolution of the camera: by ImageCapture where there is it, else from the largest mode of the
// stream.

const QUALITY = 0.95, RESIZE_MS = 2500, SETTLE_FRAMES = 3;

/** The camera cannot take a photo now. */
export class NoPhoto extends Error {}

/**
 * A photo from a video track, {blob, source}: "still" by takePhoto, "stream" from the largest mode.
 * @param video element that plays the track.
 */
export async function takePhoto(track, video) {
  if (!track || track.readyState !== "live") throw new NoPhoto("no camera");
  if (globalThis.ImageCapture?.prototype.takePhoto) {
    try {
      return { blob: await fullSize(track), source: "still" };
    } catch { /* some cameras offer no still: the stream has one */ }
  }
  return { blob: await fromStream(track, video), source: "stream" };
}

/** A still of the largest size of the camera. */
async function fullSize(track) {
  const capture = new ImageCapture(track);
  const { imageWidth, imageHeight } = (await capture.getPhotoCapabilities?.().catch(() => null)) ?? {};
  const size = imageWidth?.max && imageHeight?.max ? { imageWidth: imageWidth.max, imageHeight: imageHeight.max } : undefined;
  const blob = await capture.takePhoto(size).catch((error) => (size ? capture.takePhoto() : Promise.reject(error)));
  if (!blob?.size) throw new NoPhoto("empty photo");
  return asJpeg(blob);
}

/** A picture as JPEG, which is what the station takes; throws where the browser cannot read it. */
export async function asJpeg(blob) {
  if (blob.type === "image/jpeg") return blob;
  const picture = await createImageBitmap(blob);
  try {
    return await encoded(picture, picture.width, picture.height);
  } finally {
    picture.close();
  }
}

async function encoded(source, width, height) {
  const canvas = document.createElement("canvas");
  [canvas.width, canvas.height] = [width, height];
  canvas.getContext("2d", { alpha: false }).drawImage(source, 0, 0);
  const blob = await new Promise((resolve) => canvas.toBlob(resolve, "image/jpeg", QUALITY));
  if (!blob) throw new NoPhoto("no picture");
  return blob;
}

/** A frame of the stream in its largest mode of the same shape; the stream returns to its mode afterwards. */
async function fromStream(track, video) {
  const before = track.getSettings(), most = track.getCapabilities?.() ?? {};
  const isLarger = most.width?.max > before.width;
  try {
    if (isLarger) {
      const width = most.width.max, resized = once(video, "resize", RESIZE_MS);
      await track.applyConstraints({ width: { ideal: width }, height: { ideal: Math.round((width * before.height) / before.width) } });
      await resized;
      for (let i = 0; i < SETTLE_FRAMES; i++) await nextFrame(video);
    }
    return await still(video);
  } finally {
    if (isLarger) {
      const { width, height, frameRate } = before;
      await track.applyConstraints({ width: { ideal: width }, height: { ideal: height }, frameRate: { ideal: frameRate } }).catch(() => {});
    }
  }
}

async function still(video) {
  if (!video.videoWidth) throw new NoPhoto("no picture");
  return encoded(video, video.videoWidth, video.videoHeight);
}

const once = (target, name, withinMs) => new Promise((resolve) => {
  target.addEventListener(name, resolve, { once: true });
  setTimeout(resolve, withinMs);
});

const nextFrame = (video) => new Promise((resolve) => {
  if (video.requestVideoFrameCallback) video.requestVideoFrameCallback(resolve);
  else requestAnimationFrame(resolve);
  setTimeout(resolve, 300);
});
