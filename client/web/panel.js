// The controls beside the picture. Every control is a name and a value that the viewer knows; what it answers is shown.

const NUMBERS = [
  // name, label, least, most, what the middle reads, unit
  ['triangles', 'Triangles', 1e3, 1e7, (v) => count(v)],
  ['tolerance', 'Largest error', 0.1, 50, (v) => `${round(v)} px`],
  ['rate', 'Bandwidth', 1e4, 1e8, (v) => `${bytes(v)}/s`],
  ['fps', 'Frame rate', 5, 120, (v) => `${Math.round(v)} fps`],
  ['memory', 'Memory', 32, 8192, (v) => `${Math.round(v)} MiB`],
];
// What is there unless someone chooses: the renderer's defaults.
const BACKGROUND = '#1e2126';
const LIGHT = [0.3, 0.4, 1];
const VIEWS = ['front', 'back', 'left', 'right', 'top', 'bottom', 'iso', 'home'];
const CHECKS = [['smooth', 'Smooth'], ['colors', 'Colours'], ['wireframe', 'Wireframe'], ['levels', 'Detail levels'], ['backs', 'Mark backs'], ['occlusion', 'Crevices'], ['morph', 'Morphing'], ['gradient', 'Gradient']];
const TIPS = {
  levels: 'Faces coloured by how fine they are', backs: 'Backs of faces in red', occlusion: 'Darker crevices (ambient occlusion)', morph: 'New detail moves into its place',
  gradient: 'The background is lighter above', freeze: 'Detail stays that of the view as it is now: look at it from elsewhere (V)',
};
const FIGURES = ['Triangles', 'Limit', 'Whole model', 'Error', 'Receiving', 'Received', 'Round trip', 'Images', 'From cache', 'Memory'];

export const count = (n) => (n >= 1e6 ? `${round(n / 1e6)} M` : n >= 1e4 ? `${Math.round(n / 1e3)} k` : String(Math.round(n)));
const round = (x) => String(Number(x.toPrecision(3)));
const bytes = (n) => (n >= 1e6 ? `${round(n / 1e6)} MB` : n >= 1e3 ? `${round(n / 1e3)} kB` : `${Math.round(n)} B`);

function make(tag, properties = {}, ...children) {
  const { dataset, ...rest } = properties;
  const element = Object.assign(document.createElement(tag), rest);
  Object.assign(element.dataset, dataset);
  element.append(...children);
  return element;
}

const group = (title, isOpen, ...children) => make('details', { open: isOpen }, make('summary', {}, title), ...children);

// `send(name, value)` gives a command to the viewer.
export class Panel {
  constructor(root, send, actions, isSmall) {
    this.send = send;
    this.numbers = new Map();
    this.checks = new Map();
    const row = NUMBERS.map((entry) => this.number(...entry));
    const views = VIEWS.map((view) => make('button', { type: 'button', textContent: view[0].toUpperCase() + view.slice(1), dataset: { view }, onclick: () => send('view', view) }));
    const checks = CHECKS.map(([name, label]) => this.check(name, label));
    this.background = make('input', { type: 'color', value: BACKGROUND, ariaLabel: 'Background', oninput: () => send('background', this.background.value.slice(1)) });
    this.up = make('select', { ariaLabel: 'Axis that is up', onchange: () => send('up', this.up.value) }, make('option', { value: 'y' }, 'Y up'), make('option', { value: 'z' }, 'Z up'));
    this.light = ['x', 'y'].map((axis) => make('input', { type: 'range', min: -1.5, max: 1.5, step: 0.05, value: LIGHT[axis === 'x' ? 0 : 1], ariaLabel: `Light ${axis === 'x' ? 'from left to right' : 'from below to above'}`, oninput: () => send('light', `${this.light[0].value},${this.light[1].value},1`) }));
    this.axis = make('select', { ariaLabel: 'Section axis', id: 'section-axis', onchange: () => this.section() }, ...['off', 'x', 'y', 'z'].map((value) => make('option', { value }, value === 'off' ? 'Off' : value.toUpperCase())));
    this.share = make('input', { type: 'range', id: 'section-share', min: 0, max: 1, step: 0.001, value: 0.5, ariaLabel: 'Section position', oninput: () => this.section() });
    this.flip = make('input', { type: 'checkbox', id: 'section-flip', onchange: () => this.section() });
    this.length = make('p', { className: 'big', id: 'distance' });
    this.points = make('p', { id: 'points' });
    this.record = make('button', { type: 'button', id: 'record', onclick: () => send('record', this.record.ariaPressed === 'true' ? 'off' : 'on') }, 'Record');
    this.play = make('button', { type: 'button', id: 'play', onclick: () => (this.play.ariaPressed === 'true' ? send('play', 'off') : actions.play()) }, 'Play…');
    this.figures = FIGURES.map((name) => make('dd', { id: `figure-${name.toLowerCase().replaceAll(' ', '-')}` }));
    root.append(
      group('Detail', true, ...row),
      group('Shading', !isSmall, make('div', { className: 'checks' }, ...checks),
        make('div', { className: 'row' }, make('span', {}, 'Light'), make('div', {}, ...this.light), make('button', { type: 'button', onclick: () => send('light', 'auto') }, 'Reset')),
        make('div', { className: 'row' }, make('span', {}, 'Background'), this.background, make('button', { type: 'button', onclick: () => send('background', 'auto') }, 'Reset'))),
      group('Views', !isSmall, make('div', { className: 'buttons' }, ...views, this.up), make('div', { className: 'checks' }, this.check('freeze', 'Freeze view'))),
      group('Section', false, make('div', { className: 'row' }, make('label', { htmlFor: 'section-axis' }, 'Cut along'), this.axis, make('label', {}, this.flip, ' Flip')),
        make('div', { className: 'row' }, make('label', { htmlFor: 'section-share' }, 'Position'), this.share, make('output'))),
      group('Distance', false, this.length, this.points, make('div', { className: 'buttons' }, make('button', { type: 'button', id: 'clear', onclick: () => send('clear', '') }, 'Clear')),
        make('p', {}, 'Choose Measure, then two points. With keys: M, then Enter marks what is in the middle.')),
      group('Recorder', false, make('div', { className: 'buttons' }, this.record, this.play), make('p', {}, 'Play takes a file, and so does the page: drop it anywhere. lodestream view --play and load --path take it too.')),
      group('Figures', !isSmall, make('dl', {}, ...FIGURES.flatMap((name, k) => [make('dt', {}, name), this.figures[k]]))),
      group('Keys', false, make('p', {}, 'Drag turns, right drag or two fingers move, wheel or pinch zooms, double click goes there.'),
        make('dl', {}, ...[['Turn, move', '← → ↑ ↓, Shift'], ['Zoom', '+ −'], ['Fly', 'W A S D Q E'], ['Views', '1 – 7, H'], ['Whole model', 'F'], ['Parallel', 'O'], ['Measure', 'M, Enter'], ['Fly mode', 'G'], ['Freeze view', 'V'], ['Controls', 'C']].flatMap(([what, keys]) => [make('dt', {}, what), make('dd', {}, make('kbd', {}, keys))]))),
    );
  }

  // A slider on a logarithmic scale that may be left to the program.
  number(name, label, least, most, words) {
    const output = make('output', { htmlFor: name });
    const slider = make('input', { type: 'range', id: name, min: 0, max: 1, step: 0.005 });
    const auto = make('input', { type: 'checkbox', id: `${name}-auto`, checked: true });
    const value = () => least * (most / least) ** Number(slider.value);
    const send = () => this.send(name, auto.checked ? 'auto' : String(name === 'tolerance' ? Number(value().toPrecision(2)) : Math.round(value())));
    slider.oninput = () => { auto.checked = false; send(); };
    auto.onchange = send;
    // `inForce` is what the program chooses where the setting is left to it; nothing if that is no limit.
    this.numbers.set(name, (text, inForce) => {
      auto.checked = text === 'auto';
      const shown = Number(text === 'auto' ? inForce ?? most : text);
      output.value = text === 'auto' && inForce === undefined ? 'no limit' : words(shown);
      slider.classList.toggle('auto', text === 'auto');
      if (document.activeElement !== slider) slider.value = Math.log(Math.max(shown, least) / least) / Math.log(most / least);
      slider.ariaValueText = text === 'auto' ? `automatic, ${output.value}` : output.value;
    });
    return make('div', { className: 'row number' }, make('label', { htmlFor: name }, label), output, make('label', { className: 'auto' }, auto, 'auto'), slider);
  }

  check(name, label) {
    const box = make('input', { type: 'checkbox', id: `check-${name}` });
    box.onchange = () => (name === 'smooth' ? this.send('shading', box.checked ? 'smooth' : 'flat') : this.send(name, box.checked ? 'on' : 'off'));
    this.checks.set(name, box);
    return make('label', { title: TIPS[name] ?? '' }, box, label);
  }

  section() {
    this.send('section', this.axis.value === 'off' ? 'off' : `${this.axis.value},${this.share.value}${this.flip.checked ? ',flip' : ''}`);
  }

  // What the viewer says its settings are.
  show(settings) {
    this.triangles = settings.get('triangles');
    for (const [name, set] of this.numbers) set(settings.get(name), settings.get(`auto.${name}`));
    for (const [name, box] of this.checks) {
      const value = name === 'smooth' ? settings.get('shading') === 'smooth' : settings.get(name);
      box.checked = value === true || value === 'on' || (value === 'auto' && (name === 'morph' || settings.get(`auto.${name}`) === 'on' || (name === 'occlusion' ? settings.get('occluded') : settings.get('hascolors')) === 'on'));
    }
    this.checks.get('colors').disabled = settings.get('hascolors') !== 'on';
    this.up.value = settings.get('up');
    // Links set these too.
    const [background, light] = [settings.get('background'), settings.get('light')];
    if (document.activeElement !== this.background) this.background.value = background === 'auto' ? BACKGROUND : `#${background}`;
    const direction = light === 'auto' ? LIGHT : light.split(',').map(Number);
    this.light.forEach((slider, k) => { if (document.activeElement !== slider) slider.value = direction[k] / (direction[2] || 1); });
    const [axis, share, flip] = settings.get('section').split(',');
    this.axis.value = axis;
    this.share.disabled = this.flip.disabled = axis === 'off';
    if (share && document.activeElement !== this.share) this.share.value = share;
    this.flip.checked = flip === 'flip';
    this.record.ariaPressed = String(settings.get('record') === 'on');
    this.record.textContent = settings.get('record') === 'on' ? 'Stop and save' : 'Record';
    this.play.ariaPressed = String(settings.get('play') === 'on');
    this.play.textContent = settings.get('play') === 'on' ? 'Stop' : 'Play…';
    for (const button of document.querySelectorAll('[data-switch]')) button.ariaPressed = String(settings.get(button.dataset.switch) === 'on');
    for (const button of document.querySelectorAll('[data-tool]')) button.ariaPressed = String(settings.get('tool') === button.dataset.tool);
    document.body.dataset.tool = settings.get('tool');
  }

  // The numbers of `Page.figures`.
  measure([triangles, limit, model, error, rate, received, trip, images, hits, memory]) {
    if (this.triangles === 'auto') this.numbers.get('triangles')('auto', limit);
    const known = (x, words) => (Number.isNaN(x) ? '–' : words(x));
    const texts = [count(triangles), count(limit), count(model), known(error, (x) => `${round(x)} px`), `${bytes(rate)}/s`, bytes(received),
      known(trip, (x) => `${Math.round(x)} ms`), images > 0 ? `${Math.round(images)} /s` : 'at rest', known(hits, (x) => `${Math.round(100 * x)} %`), bytes(memory)];
    texts.forEach((text, k) => { if (this.figures[k].textContent !== text) this.figures[k].textContent = text; });
  }

  distance(length, marks) {
    const isExact = marks.every((mark) => mark.exact);
    this.length.textContent = Number.isNaN(length) ? '' : `${isExact ? '' : '≈ '}${Number(length.toPrecision(7))}`;
    const point = (mark) => `${mark.exact ? '' : '≈ '}${mark.point.map((x) => Number(x.toPrecision(7))).join(', ')}`;
    this.points.textContent = marks.map(point).join(' — ');
    this.length.dataset.exact = String(isExact);
  }
}
