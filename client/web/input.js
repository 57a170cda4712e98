// Pointers, wheel and keys of the canvas.

const TYPING = new Set(['INPUT', 'SELECT', 'TEXTAREA']);
const LINE_PX = 40;

export function listen(canvas, page, ratio, changed) {
  const at = (event) => {
    const box = canvas.getBoundingClientRect();
    return [(event.clientX - box.left) * ratio(), (event.clientY - box.top) * ratio()];
  };
  const on = (target, name, act, options) =>
    target.addEventListener(name, (event) => { act(event); changed(); }, options);

  on(canvas, 'pointerdown', (event) => {
    canvas.focus({ preventScroll: true });
    canvas.setPointerCapture(event.pointerId);
    const secondary = event.pointerType !== 'touch' && (event.button !== 0 || event.shiftKey || event.ctrlKey);
    page.press(performance.now(), event.pointerId, secondary, ...at(event));
  });
  on(canvas, 'pointermove', (event) => {
    if (!canvas.hasPointerCapture(event.pointerId)) return;
    page.motion(performance.now(), event.pointerId, ...at(event));
  });
  on(canvas, 'pointerup', (event) => page.release(performance.now(), event.pointerId));
  on(canvas, 'pointercancel', () => page.cancel(performance.now()));
  on(window, 'blur', () => page.cancel(performance.now()));
  canvas.addEventListener('contextmenu', (event) => event.preventDefault());
  on(canvas, 'wheel', (event) => {
    event.preventDefault();
    const unit = [1, LINE_PX, canvas.clientHeight][event.deltaMode];
    // A pinch of a touchpad comes as a wheel with Ctrl, in small numbers.
    page.wheel(performance.now(), ...at(event), event.deltaY * unit * (event.ctrlKey ? 5 : 1));
  }, { passive: false });
  on(window, 'keydown', (event) => {
    if (event.ctrlKey || event.metaKey || event.altKey || TYPING.has(event.target.tagName)) return;
    if (event.code === 'Enter' && event.target === canvas && /^tool=measure$/m.test(page.settings())) {
      page.command(performance.now(), 'pick', `${canvas.width / 2},${canvas.height / 2}`);
    } else if (event.code === 'KeyC') {
      document.getElementById('toggle').click();
    } else if (page.key(performance.now(), event.code, true, event.shiftKey)) {
      event.preventDefault();
    }
  });
  on(window, 'keyup', (event) => page.key(performance.now(), event.code, false, event.shiftKey));
}
