// Reads the pictures that pages and programs write: 8 bits a channel, RGB or RGBA, not interlaced.

import { readFileSync } from 'node:fs';
import { inflateSync } from 'node:zlib';

export function decode(path) {
  const file = readFileSync(path);
  const parts = [];
  let header;
  for (let at = 8; at < file.length;) {
    const length = file.readUInt32BE(at);
    const kind = file.toString('latin1', at + 4, at + 8);
    const data = file.subarray(at + 8, at + 8 + length);
    if (kind === 'IHDR') header = data;
    if (kind === 'IDAT') parts.push(data);
    at += 12 + length;
  }
  const [width, height, depth, color, interlace] = [header.readUInt32BE(0), header.readUInt32BE(4), header[8], header[9], header[12]];
  const channels = { 2: 3, 6: 4 }[color];
  if (depth !== 8 || !channels || interlace) throw new Error(`${path} is of a kind that is not read here`);
  const raw = inflateSync(Buffer.concat(parts));
  const stride = width * channels;
  const rgb = new Uint8Array(width * height * 3);
  let above = new Uint8Array(stride);
  for (let y = 0; y < height; y++) {
    const filter = raw[y * (stride + 1)];
    const row = Uint8Array.from(raw.subarray(y * (stride + 1) + 1, (y + 1) * (stride + 1)));
    for (let i = 0; i < stride; i++) {
      const [left, up, corner] = [row[i - channels] ?? 0, above[i], above[i - channels] ?? 0];
      const paeth = () => {
        const [a, b, c] = [left, up, corner].map((value) => Math.abs(left + up - corner - value));
        return a <= b && a <= c ? left : b <= c ? up : corner;
      };
      row[i] += [0, left, up, (left + up) >> 1, filter === 4 ? paeth() : 0][filter];
    }
    for (let x = 0; x < width; x++) for (let k = 0; k < 3; k++) rgb[3 * (y * width + x) + k] = row[x * channels + k];
    above = row;
  }
  return { width, height, rgb };
}

// How far a page's picture may be from a native one. Browsers average edges in encoded light, so what lies across one differs: the
// mean of a channel, and the share of pixels off by more than 8.
export const CLOSE = { mean: 0.25, far: 0.006 };

// How far two pictures of one size are apart: mean and largest difference of a channel, and the share of pixels in which some
// channel differs by more than 8.
export function difference(a, b) {
  if (a.width !== b.width || a.height !== b.height) throw new Error(`${a.width}x${a.height} is not ${b.width}x${b.height}`);
  let [sum, most, far] = [0, 0, 0];
  for (let i = 0; i < a.rgb.length; i += 3) {
    let worst = 0;
    for (let k = i; k < i + 3; k++) {
      const off = Math.abs(a.rgb[k] - b.rgb[k]);
      sum += off;
      worst = Math.max(worst, off);
    }
    most = Math.max(most, worst);
    far += worst > 8;
  }
  return { mean: sum / a.rgb.length, most, far: far / (a.width * a.height) };
}
