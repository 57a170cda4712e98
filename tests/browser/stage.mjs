// A server of its own with models of known shape, and a browser without a screen or a graphics card.

import { spawn, spawnSync } from 'node:child_process';
import { mkdtempSync, mkdirSync, readFileSync, readdirSync, rmSync, writeFileSync } from 'node:fs';
import { connect, createServer } from 'node:net';
import { tmpdir } from 'node:os';
import { performance } from 'node:perf_hooks';
import { Transform } from 'node:stream';
import { basename, dirname, join } from 'node:path';
import { fileURLToPath } from 'node:url';
import { chromium } from 'playwright-core';
import { decode } from './png.mjs';

const root = join(dirname(fileURLToPath(import.meta.url)), '..', '..');
const built = process.env.CARGO_TARGET_DIR ?? join(root, 'target');
const program = process.env.SERVER_BIN ?? join(built, 'debug', 'lodestream-server');
const bundle = join(built, 'browser', 'bundle');
// The module for browsers without WebGPU takes minutes to build, and may not be there.
export const hasWebgl = readdirSync(bundle, { recursive: true }).some((name) => name.endsWith('webgl.js'));
export const pictures = join(built, 'browser', 'pictures');

// WebGPU and the picture by software; the rest keeps Chromium from speaking to anyone else.
const QUIET = [
  '--headless', '--no-sandbox', '--disable-background-networking', '--disable-component-update', '--disable-sync', '--no-first-run',
  '--disable-domain-reliability', '--metrics-recording-only',
];
const WEBGPU = [
  '--enable-unsafe-webgpu', '--use-webgpu-adapter=swiftshader', '--enable-features=Vulkan', '--use-vulkan=swiftshader', '--use-angle=vulkan',
];
const WEBGL = ['--use-angle=swiftshader', '--enable-unsafe-swiftshader', '--disable-features=WebGPU', '--disable-blink-features=WebGPU'];

function freePort() {
  return new Promise((resolve) => {
    const server = createServer().listen(0, '127.0.0.1', () => {
      const { port } = server.address();
      server.close(() => resolve(port));
    });
  });
}

// What goes through one direction of a slow line: so many bytes per second for all connections together, each chunk late.
class Lane extends Transform {
  constructor(cable, direction, extraMs) {
    super({ highWaterMark: 16384 });
    Object.assign(this, { cable, direction, extraMs });
  }

  _transform(chunk, encoding, done) {
    const { rate, delayMs, free } = this.cable;
    const now = performance.now();
    const sent = Math.max(now, free[this.direction]) + (1000 * chunk.length) / rate;
    free[this.direction] = sent;
    this.cable.bytes[this.direction] += chunk.length;
    // The first bytes of a connection wait for its handshake.
    const arrives = sent + delayMs + this.extraMs;
    this.extraMs = 0;
    setTimeout(() => this.push(chunk), arrives - now);
    // The next chunk goes when the line is free, not when this one is there.
    setTimeout(done, Math.max(0, sent - now));
  }

  _flush(done) {
    setTimeout(done, this.cable.delayMs + 1);
  }
}

// A way to a port that can be cut, at a port of its own. With a rate (bytes per second each way) and a delay (one way), it is slow.
export class Cable {
  static async lay(port, { rate, delayMs = 0 } = {}) {
    const cable = Object.assign(new Cable(), { rate, delayMs, isOut: false, free: [0, 0], bytes: [0, 0], ends: new Set() });
    cable.server = createServer({ noDelay: true }, (near) => {
      if (cable.isOut) {
        near.on('error', () => {});
        near.resetAndDestroy();
        return;
      }
      const far = connect({ port, host: '127.0.0.1', noDelay: true });
      for (const [direction, [end, other]] of [[near, far], [far, near]].entries()) {
        cable.ends.add(end);
        end.on('error', () => {});
        end.on('close', () => { cable.ends.delete(end); other.destroy(); });
        if (rate) end.pipe(new Lane(cable, direction, direction === 0 ? 2 * delayMs : 0)).pipe(other);
        else end.pipe(other);
      }
    });
    await new Promise((resolve) => { cable.server.listen(0, '127.0.0.1', resolve); });
    cable.port = cable.server.address().port;
    return cable;
  }

  // All connections break without a word, and new ones at once, until it is mended.
  cut() {
    this.isOut = true;
    for (const end of this.ends) end.resetAndDestroy();
  }

  mend() {
    this.isOut = false;
  }

  close() {
    this.cut();
    this.server.close();
  }
}

// The cube from -1 to 1, each side `n` by `n` squares of two triangles, as OBJ.
function cube(n) {
  const lines = [];
  const numbers = new Map();
  const vertex = (point) => {
    const key = point.join(' ');
    if (!numbers.has(key)) {
      numbers.set(key, numbers.size + 1);
      lines.push(`v ${key}`);
    }
    return numbers.get(key);
  };
  const faces = [];
  for (const axis of [0, 1, 2]) {
    for (const side of [-1, 1]) {
      const at = (i, j) => {
        const point = [];
        point[axis] = side;
        point[(axis + 1) % 3] = (2 * i) / n - 1;
        point[(axis + 2) % 3] = (2 * j) / n - 1;
        return vertex(point);
      };
      for (let i = 0; i < n; i++) {
        for (let j = 0; j < n; j++) {
          const [a, b, c, d] = [at(i, j), at(i + 1, j), at(i + 1, j + 1), at(i, j + 1)];
          const [p, q] = side > 0 ? [b, d] : [d, b];
          faces.push(`f ${a} ${p} ${c}`, `f ${a} ${c} ${q}`);
        }
      }
    }
  }
  return [...lines, ...faces, ''].join('\n');
}

export class Stage {
  // With models of its own, or those of a repository.
  static async open(repository) {
    const stage = new Stage();
    stage.folder = mkdtempSync(join(tmpdir(), 'lodestream-browser-'));
    stage.repository = repository ?? join(stage.folder, 'models');
    mkdirSync(pictures, { recursive: true });
    if (!repository) {
      mkdirSync(stage.repository);
      writeFileSync(join(stage.folder, 'cube.obj'), cube(24));
      stage.call('ingest', join(stage.folder, 'cube.obj'), '--repository', stage.repository);
      stage.call('sample', '--triangles', '60000', join(stage.folder, 'scan.ply'));
      stage.call('ingest', join(stage.folder, 'scan.ply'), '--repository', stage.repository);
    }
    stage.port = await freePort();
    await stage.serve();
    stage.browser = await stage.launch();
    return stage;
  }

  launch(withWebgpu = true) {
    return chromium.launch({ executablePath: process.env.CHROMIUM ?? '/usr/bin/chromium', args: [...QUIET, ...(withWebgpu ? WEBGPU : WEBGL)] });
  }

  call(...args) {
    const { status, stderr } = spawnSync(program, args, { encoding: 'utf8' });
    if (status !== 0) throw new Error(`lodestream-server ${args[0]} failed: ${stderr}`);
  }

  // Starts the server, at the same address each time.
  async serve(environment = {}) {
    const args = ['serve', '--repository', this.repository, '--listen', `127.0.0.1:${this.port}`, '--viewer', bundle];
    this.server = spawn(program, args, { stdio: ['ignore', 'pipe', 'inherit'], env: { ...process.env, LODESTREAM_LOG_FILTER: 'error', ...environment } });
    await new Promise((resolve, reject) => {
      this.server.stdout.once('data', resolve);
      this.server.once('exit', (code) => reject(new Error(`the server ended with ${code}`)));
    });
  }

  async stop(signal = 'SIGTERM') {
    const ended = new Promise((resolve) => this.server.once('exit', resolve));
    this.server.kill(signal);
    await ended;
  }

  // The program without a window draws what a link shows, or the whole model. Returns where the picture is.
  snapshot(model, link, [width, height], name) {
    const output = join(pictures, `${name}.png`);
    const client = process.env.CLIENT_BIN ?? join(built, 'debug', 'lodestream');
    const args = ['snapshot', this.address(`/models/${model}`), '--size', `${width}x${height}`, ...(link ? pose(link) : []), '--output', output];
    const { status, stderr } = spawnSync(client, args, { encoding: 'utf8' });
    if (status !== 0) throw new Error(`lodestream snapshot failed: ${stderr}`);
    return output;
  }

  address(path, port = this.port) {
    return `http://127.0.0.1:${port}${path}`;
  }

  // A page that remembers what went wrong on it, in `page.faults`.
  async page(path, { port = this.port, browser = this.browser, script = () => {}, listen = () => {}, ...options } = {}) {
    const context = await browser.newContext({ viewport: { width: 1120, height: 600 }, ...options });
    this.contexts = [...(this.contexts ?? []), context];
    const page = await context.newPage();
    await page.addInitScript(script);
    listen(page);
    page.faults = [];
    page.on('console', (message) => { if (['error', 'warning'].includes(message.type())) page.faults.push(message.text()); });
    page.on('pageerror', (error) => page.faults.push(String(error)));
    page.on('request', (request) => { if (!request.url().startsWith(this.address('/', port)) && !/^(data|blob):/.test(request.url())) page.faults.push(`asked for ${request.url()}`); });
    await page.goto(this.address(path, port));
    return page;
  }

  // A page that a failed test left would take its place on the server.
  async closePages() {
    for (const context of (this.contexts ?? []).splice(0)) await context.close();
  }

  async close() {
    await this.browser?.close();
    if (this.server?.exitCode === null) await this.stop();
    rmSync(this.folder, { recursive: true });
  }
}

export const PATIENCE = 30_000;

// Waits for a state of the viewer.
export const state = (page, name, timeout = PATIENCE) => page.waitForSelector(`#state[data-state="${name}"]`, { timeout })
  .catch(async () => { throw new Error(`not ${name} but ${await page.textContent('#state')}; ${page.faults}`); });

// Waits until the camera rests and the mesh is what it asks for.
export async function settled(page) {
  let before = '';
  for (let k = 0; k < 100; k++) {
    await state(page, 'settled');
    const link = await page.evaluate(() => window.lodestream.link());
    if (link === before) return link;
    before = link;
    await page.waitForTimeout(150);
  }
  throw new Error('the camera does not come to rest');
}

// The picture that the page saves.
export async function saved(page, name) {
  const [file] = await Promise.all([page.waitForEvent('download'), page.click('#shot')]);
  const path = join(pictures, `${name}.png`);
  await file.saveAs(path);
  return decode(path);
}

// A file falls on the page.
export const drop = (page, path) => page.evaluate(([text, name]) => {
  const dataTransfer = new DataTransfer();
  dataTransfer.items.add(new File([text], name));
  document.querySelector('#canvas').dispatchEvent(new DragEvent('drop', { dataTransfer, bubbles: true, cancelable: true }));
}, [readFileSync(path, 'utf8'), basename(path)]);

// Waits until the camera has moved away from a link and rests again.
export async function changed(page, from, what) {
  await page.waitForFunction((from) => window.lodestream.link() !== from, from, { timeout: PATIENCE }).catch((error) => { throw new Error(`${what}: ${error}`); });
  return settled(page);
}

// The figures by name.
export async function figures(page) {
  const names = ['triangles', 'limit', 'model', 'error', 'rate', 'received', 'trip', 'images', 'hits', 'memory', 'uploaded', 'mostUploaded', 'views', 'module', 'over', 'applied', 'mostApplied'];
  const numbers = await page.evaluate(() => window.lodestream.figures());
  return Object.fromEntries(names.map((name, k) => [name, numbers[k]]));
}

// The marks: where they are on the canvas, whether exact, and in the model.
export async function marks(page) {
  const numbers = await page.evaluate(() => window.lodestream.marks());
  return Array.from({ length: numbers.length / 6 }, (_, k) => ({ exact: numbers[6 * k + 2] === 1, point: numbers.slice(6 * k + 3, 6 * k + 6) }));
}

// Flags of the program without a window for what a link shows.
function pose(link) {
  const { at, from } = parts(link);
  const target = at.split(',').map(Number);
  const [yaw, pitch, distance] = from.split(',').map(Number);
  const [sin, cos] = [Math.sin, Math.cos].map((f) => [yaw, pitch].map((degrees) => f((degrees * Math.PI) / 180)));
  const away = [sin[0] * cos[1], sin[1], cos[0] * cos[1]];
  return ['--eye', target.map((x, k) => x + distance * away[k]).join(), '--target', target.join()];
}

// What a link says, by key.
export const parts = (link) => Object.fromEntries(link.split('&').map((pair) => pair.split('=')));
