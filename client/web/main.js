// Boots the viewer: opens the socket at once, loads the module meanwhile, then runs the loop of images.

import { Socket } from './sockets.js';
import { listen } from './input.js';
import { Panel } from './panel.js';

const [MAIN, PROBE] = [0, 1];
// A mesh that is about as good as the picture.
const ENOUGH_TRIANGLES = 10_000;
// More than the longest recording that can be made.
const MOST_RECORDING_BYTES = 64 * 2 ** 20;
const element = (id) => document.getElementById(id);
const canvas = element('canvas');
const data = document.body.dataset;

const isTouch = matchMedia('(pointer: coarse)').matches;
const isSmall = (isTouch && Math.min(screen.width, screen.height) < 820) || (navigator.deviceMemory ?? 8) <= 2;
// The server wrote what the first message is for each automatic limit: large, then small.
const [triangles, hello] = data.hello.split(',')[isSmall ? 1 : 0].split(':');
const memoryMib = isSmall ? 256 : 1024;
const ratio = () => Math.min(devicePixelRatio || 1, isSmall ? 1.5 : 2);

function setState(name, words) {
  const state = element('state');
  if (state.dataset.state !== name) state.dataset.state = name;
  const text = state.querySelector('span');
  if (text.textContent !== words) text.textContent = words;
  if (name === 'refining') element('progress').style.width = `${words.match(/\d+/)?.[0] ?? 0}%`;
}

let noticeTimer = 0;
function notice(text) {
  element('notice').textContent = text;
  element('notice').hidden = false;
  clearTimeout(noticeTimer);
  noticeTimer = setTimeout(() => { element('notice').hidden = true; }, 5000);
}

function save(blob, name) {
  const link = Object.assign(document.createElement('a'), { href: URL.createObjectURL(blob), download: name });
  link.click();
  setTimeout(() => URL.revokeObjectURL(link.href), 10_000);
}

// Settings of a link that change the first message make the early socket useless.
const early = /[#&](triangles|rate|memory)=/.test(location.hash) ? null : new Socket(hello);

// Whether drawing is done without a graphics card.
let isSlow = false;

// The first image of the page has the model's picture in it: what comes next would take its time from it. A page that is not
// looked at has no images.
const painted = Promise.race([
  new Promise((resolve) => { requestAnimationFrame(() => setTimeout(resolve)); }),
  new Promise((resolve) => { setTimeout(resolve, 250); }),
]);

async function load() {
  await painted;
  const adapter = await navigator.gpu?.requestAdapter().catch(() => null);
  isSlow = !adapter || Boolean(adapter.info?.isFallbackAdapter ?? adapter.isFallbackAdapter) || /swiftshader|llvmpipe/i.test(adapter.info?.architecture ?? '');
  const name = adapter ? 'webgpu' : 'webgl';
  let module;
  try {
    module = await import(`./${name}.js`);
  } catch {
    throw adapter
      ? 'The viewer could not be loaded.'
      : `${isSecureContext ? 'This browser has no WebGPU' : 'Browsers have WebGPU only over https or on the same computer'}, and this server has no viewer without it.`;
  }
  await module.default({ module_or_path: new URL(`./${name}.wasm`, import.meta.url) });
  return module;
}

function fit() {
  const width = Math.max(1, Math.round(canvas.clientWidth * ratio()));
  const height = Math.max(1, Math.round(canvas.clientHeight * ratio()));
  if (canvas.width === width && canvas.height === height) return false;
  [canvas.width, canvas.height] = [width, height];
  return true;
}

function run(module, screen) {
  const now = () => performance.now();
  const hint = Float64Array.from(data.hint ? data.hint.split(',') : [], Number);
  const page = new module.Page(canvas.width, canvas.height, ratio(), Number(triangles), memoryMib, !isSlow, Boolean(element('poster')), hint, location.hash, Math.random() * 2 ** 32);
  let device = screen.describe();
  page.attach(screen);
  const sockets = [null, null];
  let isOver = false;
  let raf = 0;
  let timer = 0;
  let dirtySettings = true;
  let poster = element('poster');
  // Link to the first view, which the picture shows, unless the page was opened with another.
  let home = /[#&]at=/.test(location.hash) ? '' : null;
  let lastLink = location.hash.slice(1);
  let linkTimer = 0;

  const wake = () => { if (!raf && !isOver) raf = requestAnimationFrame(step); };
  const fail = (error) => {
    isOver = true;
    console.error(error);
    setState('failed', `Stopped: ${typeof error === 'string' ? error : 'the viewer failed, reload the page'}`);
    sockets.forEach((socket) => socket?.close());
  };
  const guarded = (act) => (...values) => {
    if (isOver) return undefined;
    try { return act(...values); } catch (error) { return fail(error); }
  };
  const send = guarded((name, value) => {
    if (!page.command(now(), name, value)) notice(`'${name}' cannot be '${value}'`);
    dirtySettings = true;
    wake();
  });

  const connect = (which, socket) => {
    sockets[which] = socket;
    socket.listen(guarded((what, value) => {
      if (sockets[which] !== socket) return;
      if (what === 'open') page.opened(which);
      else if (what === 'frame') page.frame(now(), which, value);
      else {
        sockets[which] = null;
        page.closed(now(), which, value[0], value[2], value[1]);
      }
      wake();
    }));
  };
  const disconnect = (which) => {
    sockets[which]?.close();
    sockets[which] = null;
  };
  const pump = () => {
    for (let request = page.request(); request >= 0; request = page.request()) {
      disconnect(request % 2);
      if (request < 2) connect(request, new Socket());
    }
    for (let frame = page.transmit(now()); frame; frame = page.transmit(now())) {
      sockets[frame.socket]?.send(frame.bytes());
    }
  };

  const panel = new Panel(element('panel'), send, { play: () => file.click() }, isSmall);
  const play = async (recording) => {
    // A folder cannot be read.
    const bytes = recording.size <= MOST_RECORDING_BYTES ? await recording.arrayBuffer().catch(() => null) : null;
    if (!bytes) return notice(`'${recording.name}' cannot be read, or is too large for a recording.`);
    guarded(() => page.play(now(), new Uint8Array(bytes)))();
    dirtySettings = true;
    return wake();
  };
  const file = Object.assign(document.createElement('input'), { type: 'file', accept: '.jsonl,.json,.txt' });
  file.onchange = async () => {
    await play(file.files[0]);
    // The same file may be chosen again.
    file.value = '';
  };
  // A recording can be dropped anywhere. Whatever else is, the page stays.
  document.addEventListener('dragover', (event) => event.preventDefault());
  document.addEventListener('drop', (event) => {
    event.preventDefault();
    const [dropped] = event.dataTransfer.files;
    if (dropped) play(dropped);
  });

  const drawMarks = () => {
    const numbers = page.marks();
    const root = element('marks');
    const marks = [];
    for (let k = 0; k < numbers.length; k += 6) {
      const [x, y, exact, ...point] = numbers.slice(k, k + 6);
      marks.push({ x: x / ratio(), y: y / ratio(), exact: exact === 1, point });
    }
    if (!marks.length && root.childElementCount <= 1 && root.firstChild) return marks;
    const place = (node, x, y) => { node.style.left = `${x}px`; node.style.top = `${y}px`; };
    root.replaceChildren(Object.assign(document.createElement('div'), { className: 'aim' }));
    for (const mark of marks.filter(({ x }) => !Number.isNaN(x))) {
      const dot = Object.assign(document.createElement('div'), { className: mark.exact ? 'dot exact' : 'dot' });
      place(dot, mark.x, mark.y);
      root.append(dot);
    }
    const length = page.distance();
    if (!Number.isNaN(length) && marks.every(({ x }) => !Number.isNaN(x))) {
      const label = Object.assign(document.createElement('div'), { className: 'length', textContent: `${marks.every((mark) => mark.exact) ? '' : '≈ '}${Number(length.toPrecision(6))}` });
      place(label, (marks[0].x + marks[1].x) / 2, (marks[0].y + marks[1].y) / 2);
      root.append(label);
    }
    return marks;
  };

  const events = () => {
    for (let event = page.event(); event; event = page.event()) {
      if (event === 'notice') notice(page.notice());
      if (event === 'recorded') save(new Blob([page.recording()], { type: 'application/jsonl' }), `${data.id}-path.jsonl`);
      dirtySettings = true;
    }
  };

  let shownAt = 0;
  const show = (time) => {
    const [name, words] = page.state().split('\n');
    // With the mesh comes what is known of the model.
    if (name !== element('state').dataset.state) dirtySettings = true;
    if (!isRepairing && !isContextLost) setState(name, words);
    if (poster && ['refining', 'settled'].includes(name)) {
      // The picture is of the first view, and stays until the mesh is about as good. Who moves is not kept waiting.
      home ??= page.link();
      if (name === 'settled' || page.link() !== home || page.figures(time)[0] >= ENOUGH_TRIANGLES) {
        poster.classList.add('gone');
        poster = null;
        page.uncover(time);
        wake();
      }
    }
    if (dirtySettings) {
      dirtySettings = false;
      panel.show(new Map(page.settings().split('\n').map((line) => { const at = line.indexOf('='); return [line.slice(0, at), line.slice(at + 1)]; })));
    }
    const marks = drawMarks();
    if (time - shownAt > 250 || name === 'settled') {
      shownAt = time;
      panel.measure(page.figures(time));
      panel.distance(page.distance(), marks);
    }
    clearTimeout(linkTimer);
    linkTimer = setTimeout(() => {
      const link = page.link();
      if (link && link !== lastLink) {
        lastLink = link;
        history.replaceState(null, '', `#${link}`);
      }
    }, 300);
  };

  // The device is gone: another one draws the same mesh. While there is none the session goes on.
  let [isRepairing, isContextLost, isStale, repairs] = [false, false, false, 0];
  const restoring = () => setState('restoring', 'The graphics device was lost, starting another');
  const repair = async () => {
    restoring();
    try {
      const next = await module.Screen.open(canvas);
      device = next.describe();
      page.attach(next);
      notice('The graphics device was lost; drawing goes on with a new one.');
      [isStale, repairs, dirtySettings] = [false, 0, true];
    } catch (error) {
      if (++repairs >= 5) return fail(error);
      await new Promise((resolve) => { setTimeout(resolve, 500 * repairs); });
    }
    isRepairing = false;
    return wake();
  };
  // WebGL gives the same context back later, and only if it is asked to.
  canvas.addEventListener('webglcontextlost', guarded((event) => {
    event.preventDefault();
    isContextLost = true;
    page.detach();
    restoring();
  }));
  canvas.addEventListener('webglcontextrestored', () => {
    [isContextLost, isStale] = [false, true];
    wake();
  });

  const step = guarded(() => {
    raf = 0;
    clearTimeout(timer);
    const time = now();
    if (!isRepairing && !isContextLost && (isStale || page.is_lost())) {
      isRepairing = true;
      repair();
    }
    if (fit()) page.resize(canvas.width, canvas.height, ratio());
    pump();
    const next = page.tick(time);
    pump();
    events();
    show(time);
    if (next === 0) wake();
    // Figures fall back to rest without anything else happening.
    else timer = setTimeout(wake, next > 0 ? Math.min(next, 1000) : 1000);
  });

  if (early && page.adopt(now(), early.hello)) connect(MAIN, early);
  else early?.close();

  listen(canvas, new Proxy(page, { get: (target, name) => guarded(target[name].bind(target)) }), ratio, () => { dirtySettings = true; wake(); });
  new ResizeObserver(wake).observe(canvas);
  document.addEventListener('visibilitychange', wake);
  window.addEventListener('hashchange', () => { if (location.hash.slice(1) !== lastLink) send('open', location.hash); });
  for (const button of document.querySelectorAll('[data-do]')) button.onclick = () => send(button.dataset.do, '');
  for (const button of document.querySelectorAll('[data-switch]')) button.onclick = () => send(button.dataset.switch, button.ariaPressed === 'true' ? 'off' : 'on');
  for (const button of document.querySelectorAll('[data-tool]')) button.onclick = () => send('tool', button.ariaPressed === 'true' ? 'look' : button.dataset.tool);
  element('shot').onclick = guarded(() => {
    page.redraw(now());
    canvas.toBlob((blob) => save(blob, `${data.id}.png`), 'image/png');
  });
  element('share').onclick = guarded(async () => {
    history.replaceState(null, '', `#${(lastLink = page.link())}`);
    // Browsers let pages that came without encryption from elsewhere copy nothing.
    const isCopied = await navigator.clipboard?.writeText(location.href).then(() => true, () => false);
    notice(isCopied ? 'The link to this view is copied.' : 'The link to this view is in the address bar.');
  });
  // For tests and for the curious.
  window.lodestream = { figures: () => Array.from(page.figures(now())), marks: () => Array.from(page.marks()), distance: () => page.distance(), settings: () => page.settings(), link: () => page.link(), device: () => device };
  wake();
}

const toggle = element('toggle');
const showPanel = (isOpen) => {
  element('panel').hidden = !isOpen;
  toggle.ariaExpanded = String(isOpen);
};
toggle.onclick = () => showPanel(element('panel').hidden);
// Where it would hide the model it waits to be asked for.
showPanel(!isSmall && innerWidth > 1000);

try {
  const module = await load();
  fit();
  run(module, await module.Screen.open(canvas));
} catch (error) {
  early?.close();
  console.error(error);
  setState('failed', typeof error === 'string' ? error : 'The viewer could not be started.');
}
