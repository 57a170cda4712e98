// Measures the viewer in Chromium, for people: node measure.mjs WHAT [--repository DIR] [--model ID]... [--minutes N] [--limit N] [--tolerance PX] [--size WxH] [--set NAME=VALUE] [--seconds N] [--undrawn].
//
// pictures   a page's picture against that of the program without a window
// first      time to the poster, the first live image and all detail at 1 Mbit/s and 100 ms, from a cold and a warm cache
// frames     a recorded path of so many seconds at a triangle limit: ops and bytes for an image, times of images. Undrawn: no image before the mesh is there,
//            which takes a software rasteriser longer than the path does
// decode     splits per second of the module's decoder, decode and apply, over the frames of a page
// flight     random flight for so many minutes: memory, triangles

import assert from 'node:assert/strict';
import { readFileSync, writeFileSync } from 'node:fs';
import { join } from 'node:path';
import { parseArgs } from 'node:util';
import { CLOSE, decode, difference } from './png.mjs';
import { Cable, Stage, drop, figures, parts, pictures, saved, settled, state } from './stage.mjs';

const ALLOWANCE = 2 * 2 ** 20;
const LINE = { rate: 125_000, delayMs: 50 };

const { values, positionals } = parseArgs({
  allowPositionals: true,
  options: { repository: { type: 'string' }, model: { type: 'string', multiple: true }, minutes: { type: 'string', default: '10' }, limit: { type: 'string', default: '1000000' }, tolerance: { type: 'string', default: '0.3' }, seed: { type: 'string', default: '1' }, size: { type: 'string', default: '1120x600' }, set: { type: 'string', multiple: true, default: [] }, decoder: { type: 'string' }, seconds: { type: 'string', default: '20' }, undrawn: { type: 'boolean', default: false } },
});

const table = (head, rows) => [head, head.map(() => '---'), ...rows].forEach((row) => console.log(`| ${row.join(' | ')} |`));
const share = (sorted, part) => sorted[Math.floor(part * (sorted.length - 1))];
const kb = (bytes) => `${(bytes / 1000).toFixed(1)} KB`;

// A generator of numbers from 0 to 1 that gives the same ones for a seed.
function random(seed) {
  let state = seed >>> 0 || 1;
  return () => {
    state ^= state << 13;
    state ^= state >>> 17;
    state ^= state << 5;
    return (state >>> 0) / 2 ** 32;
  };
}

async function comparePictures(stage, models) {
  const rows = [];
  for (const model of models) {
    const home = await stage.page(`/models/${model}`);
    const link = `${(await settled(home)).split('&').slice(0, 2).join('&')}&gradient=off&occlusion=off&morph=off`;
    await home.context().close();
    const page = await stage.page(`/models/${model}#${link}`);
    await settled(page);
    const size = await page.evaluate(() => [document.querySelector('canvas').width, document.querySelector('canvas').height]);
    const native = decode(stage.snapshot(model, link, size, `native-${model}`));
    const { mean, most, far } = difference(await saved(page, `page-${model}`), native);
    assert.ok(mean <= CLOSE.mean && far <= CLOSE.far, `${model}: mean ${mean}, ${100 * far} % of pixels`);
    rows.push([model, size.join('x'), (await figures(page)).triangles, mean.toFixed(4), most, `${(100 * far).toFixed(3)} %`]);
    await page.context().close();
  }
  table(['model', 'size', 'triangles', 'mean channel difference', 'largest', 'pixels off by more than 8'], rows);
}

// When what could first be seen, in milliseconds since the navigation began.
function watch() {
  window.seen = {};
  new PerformanceObserver((list) => { for (const entry of list.getEntries()) if (entry.name === 'first-contentful-paint') window.seen.paint = entry.startTime; }).observe({ type: 'paint', buffered: true });
  new PerformanceObserver((list) => { for (const entry of list.getEntries()) if (entry.element?.id === 'poster' || entry.element?.closest?.('#poster')) window.seen.poster ??= entry.renderTime || entry.startTime; }).observe({ type: 'largest-contentful-paint', buffered: true });
  new MutationObserver(() => {
    const name = document.querySelector('#state')?.dataset.state;
    // There is a mesh, which whoever moves sees at once; else the picture stays until the mesh is about as good.
    if (['refining', 'settled'].includes(name)) window.seen.live ??= performance.now();
    if (document.querySelector('#poster.gone')) window.seen.shown ??= performance.now();
    if (name === 'settled') window.seen.settled ??= performance.now();
  }).observe(document, { subtree: true, childList: true, attributes: true, attributeFilter: ['data-state', 'class'] });
}

async function timeFirst(stage, models) {
  const rows = [];
  // Whoever follows a link has a browser that runs: what it takes to start one's graphics is no part of this.
  const first = await stage.page('/');
  await first.screenshot();
  await first.context().close();
  for (const model of models) {
    const seen = { cold: [], warm: [] };
    for (let run = 0; run < 3; run++) {
      const cable = await Cable.lay(stage.port, LINE);
      const context = await stage.browser.newContext({ viewport: { width: 1120, height: 600 } });
      for (const cache of ['cold', 'warm']) {
        const before = cable.bytes[1];
        const page = await context.newPage();
        await page.addInitScript(watch);
        await page.goto(stage.address(`/models/${model}`, cable.port));
        await page.waitForFunction(() => window.seen.settled, null, { timeout: 120_000 });
        seen[cache].push({ ...await page.evaluate(() => window.seen), received: cable.bytes[1] - before });
        await page.close();
      }
      await context.close();
      cable.close();
    }
    for (const [cache, runs] of Object.entries(seen)) {
      // The one in the middle.
      const of = (name) => runs.map((run) => run[name]).sort((x, y) => x - y)[1];
      rows.push([model, cache, ...['paint', 'poster', 'live', 'shown', 'settled'].map((name) => Math.round(of(name))), kb(of('received'))]);
    }
  }
  table(['model', 'cache', 'first paint, ms', 'poster, ms', 'live mesh, ms', 'as good, ms', 'all detail, ms', 'received'], rows);
}

// Once around, down to a third of the distance and back, in so many seconds.
function path(link, seconds) {
  const at = parts(link).at.split(',').map(Number);
  const distance = Number(parts(link).from.split(',')[2]);
  const lines = ['{"lodestream_path": 1}'];
  for (let time = 0; time <= seconds; time += 1 / 30) {
    const turn = (2 * Math.PI * time) / seconds;
    const away = distance * (0.66 + 0.34 * Math.cos(turn));
    const eye = [at[0] + away * Math.sin(turn), at[1] + 0.2 * away, at[2] + away * Math.cos(turn)];
    lines.push(JSON.stringify({ time, eye, target: at, fov: 45 }));
  }
  return `${lines.join('\n')}\n`;
}

// Times each image and what the page computes for it.
function watchImages() {
  const request = window.requestAnimationFrame.bind(window);
  window.times = { own: [], between: [], last: 0, triangles: 0, ops: 0, bytes: 0 };
  window.requestAnimationFrame = (step) => request((time) => {
    const begin = performance.now();
    step(time);
    if (window.times.isOn) {
      window.times.own.push(performance.now() - begin);
      if (window.times.last) window.times.between.push(begin - window.times.last);
      window.times.last = begin;
      const figures = window.lodestream.figures();
      for (const [name, k] of [['triangles', 0], ['bytes', 10], ['ops', 15]]) window.times[name] = Math.max(window.times[name], figures[k]);
    }
  });
}

// The first device is lost at once, and there is no other before `window.draw` is called: the session goes on meanwhile.
function holdDevice() {
  const request = GPUAdapter.prototype.requestDevice;
  const held = new Promise((resolve) => { window.draw = resolve; });
  let isFirst = true;
  GPUAdapter.prototype.requestDevice = async function (...values) {
    if (!isFirst) await held;
    const device = await request.apply(this, values);
    if (isFirst) device.destroy();
    isFirst = false;
    window.idle = () => device.queue.onSubmittedWorkDone();
    return device;
  };
}

async function timeFrames(stage, models) {
  const rows = [];
  const script = values.undrawn ? `(${watchImages})(); (${holdDevice})();` : watchImages;
  for (const model of models) {
    const [width, height] = values.size.split('x').map(Number);
    const link = [`triangles=${values.limit}`, 'memory=1024', `tolerance=${values.tolerance}`, ...values.set].join('&');
    const page = await stage.page(`/models/${model}#${link}`, { viewport: { width, height }, script });
    // All detail, or all the triangles that the limit allows but for a few, or as many as come in so many minutes.
    const [full, late] = [0.97 * Number(values.limit), Date.now() + Number(values.minutes) * 60_000];
    await page.waitForFunction(() => window.lodestream, null, { timeout: 120_000 });
    for (let triangles = 0; triangles < full && Date.now() < late && await page.getAttribute('#state', 'data-state') !== 'settled';) {
      await page.waitForTimeout(5000);
      ({ triangles } = await figures(page));
      console.error(`${model}: ${triangles} triangles`);
    }
    // An image of a million triangles takes software seconds, and the page with it.
    page.setDefaultTimeout(300_000);
    if (values.undrawn) {
      await page.evaluate(() => window.draw());
      await page.waitForSelector('#state:not([data-state="restoring"])');
      // The first image has the whole mesh to upload.
      await page.evaluate(() => new Promise((resolve) => { requestAnimationFrame(() => requestAnimationFrame(resolve)); }));
      await page.evaluate(() => window.idle());
    }
    const file = join(pictures, `${model}-path.jsonl`);
    writeFileSync(file, path(await page.evaluate(() => window.lodestream.link()), Number(values.seconds)));
    await page.evaluate(() => { window.times.isOn = true; });
    // Not by a click: one waits for images that show where the button is.
    await drop(page, file);
    page.setDefaultTimeout(300_000 + 2000 * Number(values.seconds));
    const is = (playing) => page.waitForFunction((line) => window.lodestream.settings().split('\n').includes(line), `play=${playing}`, { polling: 500 });
    await is('on');
    await is('off');
    const { own, between, triangles, ops, bytes } = await page.evaluate(() => { window.times.isOn = false; return window.times; });
    const { limit, over, memory, module } = await figures(page);
    const mib = (bytes) => (bytes / 2 ** 20).toFixed(0);
    [own, between].forEach((times) => times.sort((a, b) => a - b));
    rows.push([model, own.length, ...[own, between].flatMap((times) => [share(times, 0.5).toFixed(1), share(times, 0.99).toFixed(1)]), ops, kb(bytes), over, triangles, mib(memory), mib(module)]);
    assert.ok(over === 0 && bytes <= ALLOWANCE, `${over} images went over the allowance, ${bytes} bytes`);
    assert.ok(triangles <= limit);
    console.error(`the path is in ${file}, for lodestream view --play`);
    await page.context().close();
  }
  table(['model', 'images', 'own p50, ms', 'own p99, ms', 'interval p50, ms', 'interval p99, ms', 'most ops', 'most uploaded', 'over the allowance', 'most triangles', 'memory, MiB', 'of it module, MiB'], rows);
}

// Frames as a page receives them, decoded by the same code in a module of its own: here, by the engine that Chromium has.
async function timeDecoding(stage, models) {
  const module = await WebAssembly.compile(readFileSync(values.decoder));
  const rows = [];
  for (const model of models) {
    const frames = [];
    const listen = (page) => page.on('websocket', (socket) => socket.on('framereceived', ({ payload }) => frames.push(payload)));
    const page = await stage.page(`/models/${model}#triangles=2000000&memory=1024&tolerance=0.2`, { listen });
    await state(page, 'settled', 300_000);
    await page.context().close();
    const rates = [];
    let [splits, bytes] = [0, 0];
    for (let run = 0; run < 7; run++) {
      const { push, frame } = (await WebAssembly.instantiate(module)).exports;
      let spent = 0;
      [splits, bytes] = [0, 0];
      for (const payload of frames) {
        payload.forEach((byte) => push(byte));
        // Of the processor: others may want it too.
        const begin = process.cpuUsage();
        splits += frame();
        const { user, system } = process.cpuUsage(begin);
        spent += (user + system) / 1000;
        bytes += payload.length;
      }
      rates.push((splits / spent) * 1000);
    }
    rates.sort((a, b) => a - b);
    rows.push([model, splits, kb(bytes), ...[0, 0.5, 1].map((part) => `${(share(rates, part) / 1e6).toFixed(2)} M`)]);
  }
  table(['model', 'splits', 'frames', 'splits/s, slowest of 7', 'median', 'fastest'], rows);
}

async function fly(stage, models) {
  const minutes = Number(values.minutes);
  for (const model of models) {
    const page = await stage.page(`/models/${model}#triangles=100000&memory=128&tolerance=0.5`);
    const session = await page.context().newCDPSession(page);
    await session.send('Performance.enable');
    await state(page, 'settled', 300_000);
    await page.focus('#canvas');
    // What the page holds once all that nobody holds is gone. Between two collections the heap says when the engine thinks of one.
    const held = async () => {
      for (let k = 0; k < 2; k++) await session.send('HeapProfiler.collectGarbage');
      const { metrics } = await session.send('Performance.getMetrics');
      return ['JSHeapUsedSize', 'Nodes', 'JSEventListeners'].map((wanted) => metrics.find(({ name }) => name === wanted).value);
    };
    const kept = [];
    const next = random(Number(values.seed));
    const keys = ['KeyW', 'KeyA', 'KeyD', 'KeyQ', 'KeyE', 'ArrowLeft', 'ArrowRight', 'ArrowUp', 'ArrowDown', 'Equal', 'Minus'];
    const samples = [];
    const begin = Date.now();
    let moves = 0;
    while (Date.now() - begin < minutes * 60_000) {
      const key = keys[Math.floor(next() * keys.length)];
      await page.keyboard.down(key);
      await page.waitForTimeout(100 + 500 * next());
      await page.keyboard.up(key);
      // Far out there is nothing to see: back to a view of the model now and then.
      if (++moves % 8 === 0) await page.keyboard.press(`Digit${1 + Math.floor(next() * 7)}`);
      if (moves % 8 === 4) await page.mouse.dblclick(300 + 400 * next(), 150 + 300 * next());
      const { triangles, limit, memory, module, mostUploaded, over, views } = await figures(page);
      const at = (Date.now() - begin) / 60_000;
      samples.push({ at, triangles, limit, memory, module, mostUploaded, over, views });
      if (at >= kept.length / 2) kept.push(await held());
      assert.ok(triangles <= limit, `${triangles} triangles`);
      assert.ok(memory <= 128 * 2 ** 20, `${memory} bytes of memory`);
    }
    assert.equal(samples.at(-1).over, 0, 'images over the allowance');
    assert.deepEqual(page.faults, []);
    await state(page, 'settled').catch(() => {});
    const mib = (bytes) => (bytes / 2 ** 20).toFixed(1);
    // By thirds: what grows without bound is more in each.
    const rows = [1, 2, 3].map((third) => {
      const own = samples.filter(({ at }) => at > ((third - 1) / 3) * samples.at(-1).at && at <= (third / 3) * samples.at(-1).at);
      const most = (name) => Math.max(...own.map((sample) => sample[name]));
      const [heap, nodes, listeners] = kept[Math.floor((third / 3) * (kept.length - 1))];
      return [own.at(-1).at.toFixed(1), most('triangles'), mib(most('memory')), mib(most('module')), `${(heap / 1024).toFixed(0)} KiB`, nodes, listeners, own.at(-1).views];
    });
    console.log(`${model}: ${samples.length} samples, limit of memory 128 MiB`);
    table(['until minute', 'most triangles', 'most memory, MiB', 'module, MiB', 'heap of the page, collected', 'nodes', 'listeners', 'views'], rows);
    await page.context().close();
  }
}

const measurements = { pictures: comparePictures, first: timeFirst, frames: timeFrames, decode: timeDecoding, flight: fly };
const measure = measurements[positionals[0]];
if (!measure) {
  console.error(`usage: measure.mjs ${Object.keys(measurements).join('|')} [--repository DIR] [--model ID]... [--minutes N] [--limit N] [--tolerance PX] [--size WxH] [--set NAME=VALUE]... [--seconds N] [--undrawn] [--seed N] [--decoder MODULE.wasm]`);
  process.exit(2);
}
const stage = await Stage.open(values.repository);
try {
  await measure(stage, values.model ?? ['scan']);
} finally {
  await stage.close();
}
