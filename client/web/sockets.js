// The connections to the server: the main one is opened before the module is there, and keeps what it brings until then.

const HELD_FRAMES = 256;

// Address of the model's stream, beside the page.
function streamAddress() {
  const page = new URL(location.href);
  page.hash = '';
  page.protocol = page.protocol === 'https:' ? 'wss:' : 'ws:';
  page.pathname = page.pathname.replace(/\/$/, '') + '/stream';
  return page.href;
}

function bytesOf(hex) {
  return Uint8Array.from(hex.match(/../g) ?? [], (pair) => parseInt(pair, 16));
}

// Why a socket did not open: browsers do not say, so the address is asked without one.
async function whyClosed() {
  try {
    const answer = await fetch(streamAddress().replace(/^ws/, 'http'), { headers: { accept: 'application/json' } });
    if (answer.status === 404) return ['gone', ''];
    if (answer.status === 503) return ['full', ''];
    if (answer.status === 426) return ['lost', ''];
    return ['refused', (await answer.json()).error ?? `status ${answer.status}`];
  } catch {
    return ['lost', ''];
  }
}

// One socket. Until `listen` is called, what arrives is kept.
export class Socket {
  constructor(hello) {
    this.hello = hello && bytesOf(hello);
    this.held = [];
    this.listener = null;
    this.wasOpen = false;
    this.waiting = [];
    this.socket = new WebSocket(streamAddress());
    this.socket.binaryType = 'arraybuffer';
    this.socket.onopen = () => {
      this.wasOpen = true;
      // Whoever took this socket over counts it as open since then.
      if (this.hello) this.socket.send(this.hello);
      else this.tell('open');
      for (const bytes of this.waiting.splice(0)) this.socket.send(bytes);
    };
    this.socket.onmessage = (event) => this.tell('frame', new Uint8Array(event.data));
    this.socket.onclose = async (event) => {
      const closed = this.wasOpen ? ['closed', event.reason, event.code] : [...(await whyClosed()), 0];
      // 1006: the line broke, nobody said why.
      if (closed[0] === 'closed' && event.code === 1006) closed[0] = 'lost';
      this.tell('end', closed);
    };
  }

  tell(what, value) {
    if (this.listener) this.listener(what, value);
    else if (this.held.length < HELD_FRAMES) this.held.push([what, value]);
    else this.close();
  }

  listen(listener) {
    this.listener = listener;
    for (const [what, value] of this.held.splice(0)) listener(what, value);
  }

  send(bytes) {
    if (this.socket.readyState === WebSocket.OPEN) this.socket.send(bytes);
    else if (this.socket.readyState === WebSocket.CONNECTING) this.waiting.push(bytes);
  }

  // After this nothing is told any more.
  close() {
    this.listener = () => {};
    this.held = [];
    this.socket.close(1000);
  }
}
