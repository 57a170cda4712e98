import assert from 'node:assert/strict';
import { join } from 'node:path';
import { after, afterEach, before, test } from 'node:test';
import { CLOSE, decode, difference } from './png.mjs';
import { Cable, Stage, changed, drop, figures, hasWebgl, marks, parts, pictures, saved, settled, state, PATIENCE } from './stage.mjs';

let stage;
before(async () => { stage = await Stage.open(); });
after(() => stage?.close());
afterEach(() => stage?.closePages());

const key = async (page, ...names) => { for (const name of names) await page.keyboard.press(name); };
const picture = (page, name) => page.screenshot({ path: join(pictures, `${name}.png`) });

// Where a pixel of the front view of the cube meets its front side, z = 1.
function onFront(link, [x, y], width, height) {
  const distance = Number(parts(link).from.split(',')[2]);
  const unit = (2 * Math.tan(Math.PI / 8) * (distance - 1)) / height;
  return [(x - width / 2) * unit, (height / 2 - y) * unit, 1];
}

test('the list leads to a page that shows the picture at once and then the model', async () => {
  const page = await stage.page('/');
  assert.equal(await page.locator('li').count(), 2);
  await picture(page, 'list');
  const html = await (await fetch(stage.address('/models/scan'))).text();
  const poster = html.indexOf('id="poster"');
  assert.ok(poster > 0 && poster < 2500 && poster < html.indexOf('<script'), 'the picture comes before what loads');
  assert.ok(html.length < 60_000, `${html.length} bytes of page`);
  await page.click('text=scan');
  await settled(page);
  const { triangles, model, error, memory, received } = await figures(page);
  assert.ok(triangles > 1000 && triangles <= model && error <= 1.0 && memory > 1e6 && received > 1e4);
  assert.match(await page.textContent('#figure-triangles'), /\d/);
  await page.waitForTimeout(500);
  await picture(page, 'desktop');
  assert.deepEqual(page.faults, []);
});

// The box around what is not background: pixels that differ from the first of their row.
function box({ width, height, rgb }) {
  const edges = [width, height, -1, -1];
  for (let y = 0; y < height; y++) {
    for (let x = 0; x < width; x++) {
      const off = [0, 1, 2].map((k) => Math.abs(rgb[3 * (y * width + x) + k] - rgb[3 * y * width + k]));
      if (Math.max(...off) > 60) [edges[0], edges[1], edges[2], edges[3]] = [Math.min(edges[0], x), Math.min(edges[1], y), Math.max(edges[2], x), Math.max(edges[3], y)];
    }
  }
  return edges;
}

test('the live mesh takes over where the picture is, in pages of any shape', async () => {
  for (const [width, height] of [[1120, 600], [390, 844], [700, 700]]) {
    const shots = [];
    for (const isLive of [false, true]) {
      const page = await stage.page('/', { viewport: { width, height } });
      if (!isLive) await page.route('**/*.wasm', (route) => route.abort());
      await page.goto(stage.address('/models/scan#occlusion=off'));
      await (isLive ? settled(page) : state(page, 'failed'));
      await page.addStyleTag({ content: '#bar, #tools, #panel, #notice { display: none !important } * { transition: none !important }' });
      const path = join(pictures, `changeover-${width}x${height}-${isLive ? 'live' : 'poster'}.png`);
      await page.screenshot({ path });
      shots.push(decode(path));
      assert.equal(await page.evaluate(() => Boolean(document.querySelector('#poster:not(.gone)'))), !isLive);
      await page.context().close();
    }
    const [poster, live] = shots.map(box);
    const off = poster.map((edge, k) => Math.abs(edge - live[k]));
    assert.ok(Math.max(...off) <= 3, `${width}x${height}: the picture lies in ${poster}, the mesh in ${live}`);
    // The picture has fewer pixels, so fine relief differs.
    const { mean } = difference(...shots);
    assert.ok(mean < 3, `${width}x${height}: ${mean} of 255 apart`);
  }
});

test('keys, wheel, buttons and drags move the camera, and the address follows', async () => {
  const page = await stage.page('/models/cube');
  const links = [await settled(page)];
  const moved = async (what) => {
    links.push(await changed(page, links.at(-1), what));
    return parts(links.at(-1));
  };
  await page.focus('#canvas');
  await key(page, 'ArrowLeft', 'ArrowLeft');
  await moved('arrows turn');
  await page.mouse.move(300, 300);
  await page.mouse.wheel(0, -300);
  const near = await moved('the wheel zooms');
  assert.ok(Number(near.from.split(',')[2]) < Number(parts(links[0]).from.split(',')[2]));
  await page.mouse.down();
  await page.mouse.move(420, 330, { steps: 8 });
  await page.mouse.up();
  await moved('a drag turns');
  await page.click('[data-view="top"]');
  assert.deepEqual((await moved('top')).from.split(',').slice(0, 2), ['0', '90']);
  await page.click('[data-switch="ortho"]');
  assert.equal((await moved('parallel')).ortho, 'on');
  await page.mouse.dblclick(600, 300);
  await moved('a double click goes there');
  await page.click('[data-do="fit"]');
  assert.equal((await moved('fit')).at, '0,0,0');
  await page.keyboard.down('KeyW');
  await page.waitForTimeout(300);
  await page.keyboard.up('KeyW');
  await moved('W flies');
  await page.waitForTimeout(600);
  assert.equal(new URL(page.url()).hash, `#${links.at(-1)}`);
  assert.deepEqual(page.faults, []);
});

test('marks lie on the complete model, and the distance between them is that of the cube', async () => {
  const page = await stage.page('/models/cube#tolerance=50');
  const first = await settled(page);
  await page.focus('#canvas');
  await key(page, '1');
  const link = await changed(page, first, 'front');
  await page.click('[data-tool="measure"]');
  const [width, height] = [1120, 600];
  const pixels = [[480, 250], [620, 360]];
  for (const [x, y] of pixels) await page.mouse.click(x, y, { delay: 30 });
  await page.waitForFunction(() => document.querySelectorAll('#marks .dot.exact').length === 2, null, { timeout: PATIENCE });
  const [a, b] = await marks(page);
  assert.ok(a.exact && b.exact);
  const expected = pixels.map((pixel) => onFront(link, pixel, width, height));
  for (const [mark, point] of [[a, expected[0]], [b, expected[1]]]) {
    assert.ok(Math.abs(mark.point[2] - 1) < 1e-9, `on the side: ${mark.point}`);
    assert.ok(Math.hypot(mark.point[0] - point[0], mark.point[1] - point[1]) < 1e-4, `${mark.point} ${point}`);
  }
  const distance = await page.evaluate(() => window.lodestream.distance());
  assert.ok(Math.abs(distance - Math.hypot(...a.point.map((x, k) => x - b.point[k]))) < 1e-12);
  assert.match(await page.textContent('#marks .length'), /^\d/);
  await picture(page, 'measure');
  await key(page, 'Escape');
  await page.waitForFunction(() => document.querySelectorAll('#marks .dot').length === 0, null, { timeout: PATIENCE });
  assert.deepEqual(page.faults, []);
});

test('a section cuts away what lies beyond it', async () => {
  const page = await stage.page('/models/cube#section=x,0.5');
  const first = await settled(page);
  await page.focus('#canvas');
  await key(page, '1');
  await changed(page, first, 'front');
  await picture(page, 'section');
  await page.click('[data-tool="measure"]');
  await page.mouse.click(510, 300, { delay: 30 });
  await page.waitForFunction(() => window.lodestream.marks().length === 6, null, { timeout: PATIENCE });
  assert.ok((await marks(page))[0].point[0] < 0);
  await page.mouse.click(610, 300, { delay: 30 });
  await page.waitForSelector('#notice:not([hidden])', { timeout: PATIENCE });
  assert.match(await page.textContent('#notice'), /no surface/);
  await page.evaluate(() => { document.querySelector('#section-axis').closest('details').open = true; });
  await page.selectOption('#section-axis', 'off');
  await page.mouse.click(610, 300, { delay: 30 });
  await page.waitForFunction(() => window.lodestream.marks().length === 12, null, { timeout: PATIENCE });
  assert.deepEqual(page.faults, []);
});

test('a link leads to the same view with the same settings', async () => {
  const page = await stage.page('/models/scan');
  const first = await settled(page);
  await page.focus('#canvas');
  await key(page, '7', 'o');
  await changed(page, first, 'iso');
  await page.check('#check-wireframe');
  await page.fill('#triangles', '0.4');
  await page.waitForFunction(() => /triangles=\d/.test(window.lodestream.link()), null, { timeout: PATIENCE });
  const link = await settled(page);
  assert.match(link, /ortho=on.*triangles=\d+.*wireframe=on/);
  const other = await stage.page(`/models/scan#${link}`);
  assert.equal(await settled(other), link);
  assert.equal(await other.isChecked('#check-wireframe'), true);
  assert.equal(await other.isChecked('#triangles-auto'), false);
  await picture(other, 'wireframe');
  assert.deepEqual([...page.faults, ...other.faults], []);
});

test('the limit holds, and memory stays within what it allows', async () => {
  const page = await stage.page('/models/scan#triangles=5000&memory=64&tolerance=0.1');
  await state(page, 'settled');
  assert.match(await page.textContent('#state'), /limit/);
  await page.focus('#canvas');
  let most = 0;
  for (const view of ['1', '5', '3', '7', '2']) {
    await key(page, view);
    for (let k = 0; k < 6; k++) {
      const { triangles, limit } = await figures(page);
      most = Math.max(most, triangles);
      assert.equal(limit, 5000);
      await page.waitForTimeout(60);
    }
  }
  await settled(page);
  most = Math.max(most, (await figures(page)).triangles);
  assert.ok(most <= 5000 && most > 4000, `${most} triangles`);
  const { memory, module, mostUploaded } = await figures(page);
  assert.ok(memory < 64 * 2 ** 20, `${memory} bytes, ${module} of the module`);
  assert.ok(mostUploaded <= 2 * 2 ** 20, `${mostUploaded} bytes uploaded for an image`);
  assert.deepEqual(page.faults, []);
});

test('everything can be reached with the keyboard alone', async () => {
  const page = await stage.page('/models/cube');
  await settled(page);
  const reached = new Set();
  for (let k = 0; k < 50; k++) {
    await key(page, 'Tab');
    reached.add(await page.evaluate(() => document.activeElement.id || document.activeElement.dataset.do || document.activeElement.dataset.view || document.activeElement.dataset.switch || document.activeElement.dataset.tool || document.activeElement.tagName));
  }
  for (const wanted of ['canvas', 'back', 'toggle', 'fit', 'ortho', 'measure', 'shot', 'share', 'triangles', 'tolerance-auto', 'front', 'home']) {
    assert.ok(reached.has(wanted), `${wanted} is not among ${[...reached]}`);
  }
  await page.focus('#toggle');
  await key(page, 'Enter');
  assert.equal(await page.isVisible('#panel'), false);
  assert.equal(await page.getAttribute('#toggle', 'aria-expanded'), 'false');
  await page.focus('#canvas');
  await key(page, 'c', '1', 'm', 'Enter');
  await page.waitForFunction(() => window.lodestream.marks()[2] === 1, null, { timeout: PATIENCE });
  const before = await settled(page);
  await key(page, 'Shift+ArrowRight');
  await changed(page, before, 'Shift moves');
  await key(page, 'Enter');
  await page.waitForFunction(() => window.lodestream.distance() > 0, null, { timeout: PATIENCE });
  assert.deepEqual(page.faults, []);
});

test('a picture is saved, a recording is made and played', async () => {
  const page = await stage.page('/models/cube');
  const first = await settled(page);
  const [saved] = await Promise.all([page.waitForEvent('download'), page.click('#shot')]);
  assert.equal(saved.suggestedFilename(), 'cube.png');
  await saved.saveAs(join(pictures, 'saved.png'));
  await page.evaluate(() => document.querySelectorAll('details').forEach((group) => { group.open = true; }));
  await page.click('#record');
  await page.focus('#canvas');
  await key(page, '2');
  const there = await changed(page, first, 'back');
  const [file] = await Promise.all([page.waitForEvent('download'), page.click('#record')]);
  const path = join(pictures, 'path.jsonl');
  await file.saveAs(path);
  await key(page, '1');
  const front = await changed(page, there, 'front');
  const [chooser] = await Promise.all([page.waitForEvent('filechooser'), page.click('#play')]);
  await chooser.setFiles(path);
  await page.waitForFunction(() => /play=on/.test(window.lodestream.settings()), null, { timeout: PATIENCE });
  await page.waitForFunction(() => /play=off/.test(window.lodestream.settings()), null, { timeout: PATIENCE });
  assert.equal(parts(await settled(page)).from.split(',')[0], parts(there).from.split(',')[0]);
  // The same by dropping the file on the page.
  await key(page, '1');
  await page.waitForFunction((link) => window.lodestream.link() === link, front, { timeout: PATIENCE });
  await drop(page, path);
  await page.waitForFunction((link) => window.lodestream.link() === link, there, { timeout: PATIENCE });
  await drop(page, join(pictures, 'saved.png'));
  await page.waitForSelector('#notice:not([hidden])', { timeout: PATIENCE });
  assert.match(await page.textContent('#notice'), /cannot be played/);
  assert.deepEqual(page.faults, []);
});

test('phones get fewer triangles and fingers', async () => {
  const phone = { viewport: { width: 390, height: 844 }, screen: { width: 390, height: 844 }, isMobile: true, hasTouch: true, deviceScaleFactor: 3 };
  const page = await stage.page('/models/scan', phone);
  const first = await settled(page);
  assert.ok((await figures(page)).limit <= 200_000);
  assert.equal(await page.evaluate(() => document.querySelector('canvas').width), 585, 'the pixel ratio is capped');
  assert.equal(await page.isVisible('#panel'), false);
  assert.ok(await page.evaluate(() => document.documentElement.scrollWidth <= innerWidth), 'nothing sticks out');
  await picture(page, 'phone');
  // Whatever its name, the state is to be seen.
  await page.evaluate(() => { document.querySelector('h1').textContent = 'A model whose name is longer than a phone is wide'; });
  const words = await page.evaluate(() => { const span = document.querySelector('#state span'); return [span.scrollWidth, span.clientWidth]; });
  assert.ok(words[1] > 80 && words[0] <= words[1], `${words} of the state are there`);
  const session = await page.context().newCDPSession(page);
  const touch = (type, ...points) => session.send('Input.dispatchTouchEvent', { type, touchPoints: points.map(([x, y], id) => ({ x, y, id })) });
  await touch('touchStart', [150, 400], [250, 400]);
  for (let k = 1; k <= 5; k++) await touch('touchMove', [150 - 12 * k, 400], [250 + 12 * k, 400]);
  await touch('touchEnd');
  const pinched = await changed(page, first, 'a pinch zooms');
  const distance = (link) => Number(parts(link).from.split(',')[2]);
  assert.ok(distance(pinched) < 0.6 * distance(first), `${pinched} ${first}`);
  await page.tap('#toggle');
  assert.equal(await page.isVisible('#panel'), true);
  await picture(page, 'phone-panel');
  assert.deepEqual(page.faults, []);
});

test('a graphics device that is lost gives way to another', async () => {
  const keep = () => {
    const request = GPUAdapter.prototype.requestDevice;
    window.devices = [];
    GPUAdapter.prototype.requestDevice = async function (...values) {
      window.devices.push(await request.apply(this, values));
      return window.devices.at(-1);
    };
  };
  const page = await stage.page('/models/scan#morph=off', { script: keep });
  await settled(page);
  const [before, { triangles, received }] = [await saved(page, 'device-before'), await figures(page)];
  await page.evaluate(() => window.devices.at(-1).destroy());
  await page.waitForFunction(() => window.devices.length === 2, null, { timeout: PATIENCE });
  await page.waitForSelector('#notice:not([hidden])', { timeout: PATIENCE });
  assert.match(await page.textContent('#notice'), /device/);
  await settled(page);
  const after = await figures(page);
  assert.equal(after.triangles, triangles);
  assert.ok(after.received - received < 200, `${after.received - received} bytes: the mesh is here`);
  const { most } = difference(before, await saved(page, 'device-after'));
  assert.ok(most <= 2, `${most}: the picture is the same`);
  assert.deepEqual(page.faults.filter((fault) => !/device/i.test(fault)), []);
});

test('a browser without WebGPU draws with WebGL', { skip: hasWebgl ? false : 'the bundle has no module for it' }, async () => {
  const browser = await stage.launch(false);
  try {
    const page = await stage.page('/models/scan#occlusion=off&shading=flat&gradient=off', { browser });
    assert.equal(await page.evaluate(async () => Boolean(await navigator.gpu?.requestAdapter())), false, 'it has no WebGPU');
    await settled(page);
    assert.match(await page.evaluate(() => window.lodestream.device()), /Gl/);
    const loaded = await page.evaluate(() => performance.getEntriesByType('resource').map(({ name }) => name).filter((name) => name.endsWith('.wasm')));
    assert.ok(loaded.length === 1 && loaded[0].endsWith('webgl.wasm'), `${loaded}`);
    const seen = await saved(page, 'webgl');
    const other = await stage.page(`/models/scan#${await page.evaluate(() => window.lodestream.link())}`);
    await settled(other);
    const { mean, far } = difference(seen, await saved(other, 'webgpu'));
    assert.ok(mean < 0.5 && far < 0.01, `${mean} ${far}: it draws what WebGPU draws`);
    // The context goes and comes back.
    await page.evaluate(() => {
      window.lose = document.querySelector('canvas').getContext('webgl2').getExtension('WEBGL_lose_context');
      window.lose.loseContext();
    });
    await state(page, 'restoring');
    await page.evaluate(() => window.lose.restoreContext());
    await settled(page);
    assert.equal(difference(seen, await saved(page, 'webgl-after')).far, 0, 'the picture is the same');
    assert.deepEqual([...page.faults, ...other.faults].filter((fault) => !/context|No available adapters/i.test(fault)), []);
  } finally {
    await browser.close();
  }
});

test('a page shows what the program without a window draws', async () => {
  const first = await stage.page('/models/scan');
  const home = await settled(first);
  // From the side too, and with the link's rounding in both.
  for (const [name, from] of [['home', parts(home).from], ['side', `70,-15,${parts(home).from.split(',')[2]}`]]) {
    const link = `at=${parts(home).at}&from=${from}&gradient=off&occlusion=off&morph=off`;
    const page = await stage.page(`/models/scan#${link}`);
    await settled(page);
    const size = await page.evaluate(() => [document.querySelector('canvas').width, document.querySelector('canvas').height]);
    const native = decode(stage.snapshot('scan', link, size, `native-${name}`));
    const { mean, most, far } = difference(await saved(page, `page-${name}`), native);
    assert.ok(native.rgb.some((byte) => byte > 150), 'something is to be seen');
    assert.ok(mean <= CLOSE.mean && far <= CLOSE.far, `${name}: mean ${mean}, largest ${most}, ${100 * far} % of pixels by more than 8`);
    await page.context().close();
  }
  // Both frame the whole model alike, in images of any shape.
  for (const [width, height] of [[390, 600], [640, 300]]) {
    const page = await stage.page('/models/scan#gradient=off&occlusion=off&morph=off', { viewport: { width, height } });
    await settled(page);
    const { mean, most, far } = difference(await saved(page, `page-${width}x${height}`), decode(stage.snapshot('scan', null, [width, height], `native-${width}x${height}`)));
    assert.ok(mean <= CLOSE.mean && far <= CLOSE.far, `${width}x${height}: mean ${mean}, largest ${most}, ${100 * far} % of pixels by more than 8`);
    await page.context().close();
  }
});

test('a connection that breaks is made anew, and the session goes on', async () => {
  const cable = await Cable.lay(stage.port);
  try {
    const page = await stage.page('/models/scan', { port: cable.port });
    const link = await settled(page);
    const before = await figures(page);
    await page.evaluate(() => {
      window.seen = [];
      const look = () => { window.seen.push(window.lodestream.figures()[0]); requestAnimationFrame(look); };
      look();
    });
    cable.cut();
    await state(page, 'reconnecting');
    assert.equal((await figures(page)).triangles, before.triangles, 'the picture stays');
    cable.mend();
    assert.equal(await settled(page), link);
    // A slow machine draws few images meanwhile: some of those after it count too.
    await page.waitForFunction(() => window.seen.length > 10);
    const seen = await page.evaluate(() => window.seen);
    assert.ok(seen.every((triangles) => triangles === before.triangles), `no picture from the base on: ${seen.length} images of ${[...new Set(seen)]}, ${before.triangles} before`);
    const after = await figures(page);
    assert.equal(after.triangles, before.triangles);
    assert.ok(after.received - before.received < 200, `${after.received - before.received} bytes to go on, ${before.received} before`);
    // It goes on in earnest: another view is refined.
    await page.focus('#canvas');
    await key(page, '5');
    await changed(page, link, 'top');
    // While nothing goes through, what the page asks for fails, and the browser says so.
    assert.deepEqual(page.faults.filter((fault) => !/WebSocket|net::ERR_/.test(fault)), []);
  } finally {
    cable.close();
  }
});

test('a server that goes and comes back finds the viewer where it was', async () => {
  const page = await stage.page('/models/scan');
  const link = await settled(page);
  const { triangles } = await figures(page);
  await stage.stop('SIGKILL');
  await state(page, 'reconnecting');
  assert.equal((await figures(page)).triangles, triangles, 'the picture stays');
  await picture(page, 'reconnecting');
  await stage.serve();
  assert.equal(await settled(page), link);
  assert.equal((await figures(page)).triangles, triangles);
  // The browser itself reports sockets and addresses that nobody answers, and the answer that the server is back when the page asks
  // why a socket did not open.
  assert.deepEqual(page.faults.filter((fault) => !/ERR_CONNECTION_REFUSED|WebSocket connection|status of 426/.test(fault)), []);
});

test('a full server and a model that is gone are said', async () => {
  await stage.stop();
  await stage.serve({ LODESTREAM_RUNTIME_MAX_SESSIONS: '1' });
  const page = await stage.page('/models/cube');
  await settled(page);
  const other = await stage.page('/models/scan');
  await state(other, 'full');
  assert.equal(await other.isVisible('#poster'), true, 'its picture is there all the same');
  await page.context().close();
  await settled(other);
  await stage.stop();
  stage.repository = stage.folder;
  await stage.serve();
  await state(other, 'gone');
  await other.context().close();
});
