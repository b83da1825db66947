// Plays the pictures of a scene: two of them under a slider, all of them small, errors and maps in colour.
'use strict';

// Cividis (Nunez, Anderton and Renslow 2018), even steps: it reads the same with any colour vision.
const CIVIDIS = ['00224e', '123570', '3b496c', '575d6d', '707173', '8a8678', 'a59c74', 'c3b369', 'e1cc55', 'fee838'];
const PALETTE = palette(CIVIDIS);
// Frames whose colours are kept; older ones are computed again.
const MAX_COLOURED = 200;
const MAX_ZOOM = 16;
// Served frames that are asked for at once.
const MAX_WAITING = 2;

function palette(stops) {
  const table = new Uint32Array(256);
  for (let i = 0; i < 256; i++) {
    const at = i / 255 * (stops.length - 1), n = Math.min(Math.floor(at), stops.length - 2);
    const mix = k => {
      const [a, b] = [stops[n], stops[n + 1]].map(stop => parseInt(stop.slice(2 * k, 2 * k + 2), 16));
      return Math.round(a + (at - n) * (b - a));
    };
    table[i] = (255 << 24 | mix(2) << 16 | mix(1) << 8 | mix(0)) >>> 0;
  }
  return table;
}

// Pictures by layer and frame: in the page, or from the program that serves it.
class Pictures {
  constructor(scene, ready, failed) {
    Object.assign(this, { scene, ready, failed, kept: new Map(), waiting: new Set() });
  }

  // Returns a picture if it is there; else asks for it and returns nothing.
  get(layer, frame) {
    const { frames, path } = this.scene.layers[layer];
    const number = frames ? Math.min(frame, frames.length - 1) : frame;
    const name = `${layer} ${number}`;
    if (this.kept.has(name)) return this.kept.get(name);
    // Frames that nobody looks at any more are not asked for.
    if (!this.waiting.has(name) && (frames || this.waiting.size < MAX_WAITING)) {
      this.waiting.add(name);
      const loaded = frames ? decoded(frames[number]) : fetched(`${path}/${number}`);
      loaded.then(picture => {
        this.keep(name, picture);
        this.waiting.delete(name);
        this.ready();
      }, problem => {
        this.failed(problem.message);
        // Asked for again when it is needed, but not at once.
        setTimeout(() => { this.waiting.delete(name); this.ready(); }, problem.busy ? 300 : 5000);
      });
    }
    return undefined;
  }

  keep(name, picture) {
    this.kept.set(name, picture);
    const limit = this.scene.layers[0].frames ? Infinity : MAX_COLOURED;
    if (this.kept.size > limit) this.kept.delete(this.kept.keys().next().value);
  }
}

async function decoded(address) {
  const image = new Image();
  image.src = address;
  await image.decode();
  return image;
}

async function fetched(address) {
  const response = await fetch(address, { cache: 'no-store' });
  if (!response.ok) {
    throw Object.assign(new Error(await response.text()), { busy: response.status === 503 });
  }
  return createImageBitmap(await response.blob());
}

class Player {
  constructor(element) {
    const part = selector => element.querySelector(selector);
    this.scene = JSON.parse(part('script').textContent);
    this.canvas = part('.stage canvas');
    this.part = part;
    this.frame = Math.floor(this.scene.start ?? this.scene.frames / 2);
    this.step = 1;
    this.split = 0.5;
    this.zoom = 1;
    this.centre = [0.5, 0.5];
    this.coloured = new Map();
    this.views = views(this.scene);
    this.sides = { left: this.scene.left, right: this.scene.right };
    this.pictures = new Pictures(this.scene, () => this.draw(), text => { part('.state').textContent = text; });
    element.classList.toggle('served', Boolean(this.scene.layers[0].path));
    this.build();
    this.listen();
    new ResizeObserver(() => this.draw()).observe(part('.stage'));
    const still = matchMedia('(prefers-reduced-motion: reduce)').matches;
    if (this.scene.frames > 1 && !this.scene.layers[0].path && !still) this.play(true);
    this.draw();
  }

  build() {
    const time = this.part('.time');
    time.max = this.scene.frames - 1;
    if (this.scene.frames < 2) for (const name of ['.play', '.time', 'output']) this.part(name).hidden = true;
    for (const select of this.selects()) {
      for (const [n, view] of this.views.entries()) select.add(new Option(view.name, n));
      select.value = this.sides[select.dataset.side];
    }
    this.small = this.views.map((view, n) => {
      const button = document.createElement('button');
      button.type = 'button';
      const canvas = button.appendChild(document.createElement('canvas'));
      const name = button.appendChild(document.createElement('span'));
      name.textContent = view.name;
      if (view.note) button.appendChild(document.createElement('small')).textContent = view.note;
      button.onclick = () => this.choose('right', n);
      // Served pictures are restored when they are looked at, and no sooner.
      if (!this.scene.layers[0].path && view.of === undefined) this.part('.all').append(button);
      return { button, canvas };
    });
    const context = this.part('.key canvas').getContext('2d');
    const row = context.createImageData(256, 1);
    new Uint32Array(row.data.buffer).set(PALETTE);
    context.putImageData(row, 0, 0);
  }

  selects() { return [this.part('[data-side=left]'), this.part('[data-side=right]')]; }

  listen() {
    const { canvas, part } = this;
    for (const select of this.selects()) select.onchange = () => this.choose(select.dataset.side, +select.value);
    part('.split').oninput = e => { this.split = e.target.value / 100; this.draw(); };
    part('.time').oninput = e => { this.play(false); this.go(+e.target.value); };
    part('.play').onclick = () => this.play(!this.timer);
    part('.in').onclick = () => this.magnify(2);
    part('.out').onclick = () => this.magnify(0.5);
    part('.fit').onclick = () => this.magnify(0);
    canvas.onpointerdown = e => {
      canvas.setPointerCapture(e.pointerId);
      this.dragged = [e.clientX, e.clientY];
      if (this.zoom === 1) this.moveSplit(e);
    };
    canvas.onpointermove = e => {
      if (!this.dragged) return;
      if (this.zoom === 1) return this.moveSplit(e);
      const [x, y] = this.dragged;
      this.dragged = [e.clientX, e.clientY];
      this.pan((x - e.clientX) / canvas.clientWidth, (y - e.clientY) / canvas.clientHeight);
    };
    canvas.onpointerup = canvas.onpointercancel = () => { this.dragged = null; };
    canvas.addEventListener('wheel', e => {
      if (!e.ctrlKey && !e.metaKey) return;
      e.preventDefault();
      this.magnify(e.deltaY < 0 ? 1.25 : 0.8);
    }, { passive: false });
    canvas.onkeydown = e => this.key(e);
  }

  key(e) {
    const arrows = { ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowUp: [0, -1], ArrowDown: [0, 1] };
    const arrow = arrows[e.key];
    if (e.ctrlKey || e.metaKey || e.altKey) return;
    if (e.key === ' ') this.play(!this.timer);
    else if (e.key === '+' || e.key === '=') this.magnify(2);
    else if (e.key === '-') this.magnify(0.5);
    else if (e.key === '0') this.magnify(0);
    else if (arrow && e.shiftKey) this.pan(arrow[0] / 8, arrow[1] / 8);
    else if (arrow && arrow[0]) { this.play(false); this.go(this.frame + arrow[0]); }
    else return;
    e.preventDefault();
  }

  moveSplit(e) {
    const box = this.canvas.getBoundingClientRect();
    this.split = Math.min(Math.max((e.clientX - box.left) / box.width, 0), 1);
    this.part('.split').value = Math.round(100 * this.split);
    this.draw();
  }

  choose(side, n) {
    this.sides[side] = n;
    for (const select of this.selects()) select.value = this.sides[select.dataset.side];
    this.draw();
  }

  go(frame) {
    const last = this.scene.frames - 1;
    this.frame = Math.min(Math.max(frame, 0), last);
    this.draw();
  }

  play(on) {
    clearInterval(this.timer);
    this.timer = on ? setInterval(() => this.advance(), 1000 / (this.scene.rate ?? 10)) : null;
    const button = this.part('.play');
    button.textContent = on ? 'Pause' : 'Play';
    button.setAttribute('aria-pressed', on);
  }

  // To the end and back: a loop that jumps hides what changes.
  advance() {
    if (this.incomplete) return this.draw();
    const last = this.scene.frames - 1;
    if (this.frame + this.step > last || this.frame + this.step < 0) this.step = -this.step;
    this.go(this.frame + this.step);
  }

  magnify(factor) {
    this.zoom = factor ? Math.min(Math.max(this.zoom * factor, 1), MAX_ZOOM) : 1;
    this.part('.stage').classList.toggle('zoomed', this.zoom > 1);
    this.pan(0, 0);
  }

  // Moves the middle of what is seen, by parts of it.
  pan(x, y) {
    const half = 0.5 / this.zoom;
    this.centre = this.centre.map((at, n) => Math.min(Math.max(at + [x, y][n] / this.zoom, half), 1 - half));
    this.draw();
  }

  draw() {
    if (this.drawing) return;
    this.drawing = requestAnimationFrame(() => { this.drawing = null; this.paint(); });
  }

  paint() {
    const { canvas, scene, part } = this;
    const [left, right] = [this.sides.left, this.sides.right];
    const [a, b] = [this.picture(left, this.frame), this.picture(right, this.frame)];
    this.incomplete = !a || !b;
    if (!this.incomplete) part('.state').textContent = '';
    else if (scene.layers[0].path && !part('.state').textContent) part('.state').textContent = 'restoring ...';
    part('.time').value = this.frame;
    part('output').textContent = scene.numbers ? `frame ${scene.numbers[this.frame]}` : `${this.frame} of ${scene.frames}`;
    part('.tag.left').textContent = this.views[left].name;
    part('.tag.right').textContent = this.views[right].name;
    this.showKey([left, right].map(n => this.views[n]).find(view => view.max));
    const ratio = window.devicePixelRatio || 1;
    const [width, height] = [canvas.clientWidth, canvas.clientHeight].map(side => Math.max(Math.round(side * ratio), 1));
    if (canvas.width !== width || canvas.height !== height) [canvas.width, canvas.height] = [width, height];
    const context = canvas.getContext('2d');
    context.imageSmoothingEnabled = width < scene.width;
    const at = Math.round(this.split * width);
    if (a) this.place(context, a, 0, at);
    if (b) this.place(context, b, at, width);
    context.fillStyle = '#fff';
    context.fillRect(at - ratio, 0, 2 * ratio, height);
    context.fillStyle = 'rgb(0 0 0 / .45)';
    context.fillRect(at + ratio, 0, ratio, height);
    context.fillRect(at - 2 * ratio, 0, ratio, height);
    for (const [n, { button, canvas: small }] of this.small.entries()) {
      if (!button.isConnected) continue;
      button.setAttribute('aria-pressed', n === right);
      const picture = this.picture(n, this.frame);
      if (!picture) continue;
      const shrink = Math.max(1, Math.ceil(scene.width / 320));
      const size = [scene.width, scene.height].map(side => Math.max(Math.round(side / shrink), 1));
      if (small.width !== size[0]) [small.width, small.height] = size;
      small.getContext('2d').drawImage(picture, 0, 0, ...size);
    }
  }

  // Draws what is seen of a picture between two columns of the canvas.
  place(context, picture, from, to) {
    if (to <= from) return;
    const { width, height } = context.canvas;
    const seen = [picture.width / this.zoom, picture.height / this.zoom];
    const origin = [this.centre[0] * picture.width - seen[0] / 2, this.centre[1] * picture.height - seen[1] / 2];
    const column = x => origin[0] + x / width * seen[0];
    context.drawImage(picture, column(from), origin[1], column(to) - column(from), seen[1], from, 0, to - from, height);
  }

  // Returns a view's picture of a frame; errors and maps in colour.
  picture(n, frame) {
    const view = this.views[n];
    if (!view.max) return this.pictures.get(view.layer, frame);
    const name = `${n} ${frame}`;
    if (this.coloured.has(name)) return this.coloured.get(name);
    const own = this.pictures.get(view.layer, frame);
    const truth = view.of === undefined ? own : this.pictures.get(view.of, frame);
    if (!own || !truth) return undefined;
    const picture = coloured(samples(own), view.of === undefined ? null : samples(truth), view.max, own);
    this.coloured.set(name, picture);
    if (this.coloured.size > MAX_COLOURED) this.coloured.delete(this.coloured.keys().next().value);
    return picture;
  }

  showKey(view) {
    const key = this.part('.key');
    key.hidden = !view;
    if (!view || this.keyed === view) return;
    this.keyed = view;
    const digits = view.max < 1 ? 3 : 1;
    const marks = [0, view.max / 2, view.max].map(value => value.toFixed(digits).replace(/\.?0+$/, '') || '0');
    marks[2] += ' or more';
    [...key.querySelectorAll('span')].forEach((span, i) => { span.textContent = marks[i]; });
    key.querySelector('p').textContent = view.meaning;
  }
}

// Lists what can be looked at: the layers, and where there is a truth, the errors of the others.
function views(scene) {
  const all = scene.layers.map((layer, n) => ({ ...layer, layer: n }));
  const truth = scene.layers.findIndex(layer => layer.kind === 'truth');
  if (truth < 0) return all;
  const meaning = 'absolute error in units of white, after the best gain';
  const restored = all.filter(view => view.kind === 'restored');
  return all.concat(restored.map(view => ({ name: `error of ${view.name}`, layer: view.layer, of: truth, max: scene.errorMax, meaning })));
}

function samples(picture) {
  const canvas = new OffscreenCanvas(picture.width, picture.height);
  const context = canvas.getContext('2d', { willReadFrequently: true });
  context.drawImage(picture, 0, 0);
  return context.getImageData(0, 0, picture.width, picture.height).data;
}

// Colours values, or their distances from those of the truth, of which `max` is the end of the key. Values of a map
// reach the end of the key where they are white.
function coloured(own, truth, max, { width, height }) {
  const canvas = new OffscreenCanvas(width, height);
  const context = canvas.getContext('2d');
  const image = context.createImageData(width, height);
  const pixels = new Uint32Array(image.data.buffer);
  for (let i = 0; i < pixels.length; i++) {
    let value = own[4 * i];
    if (truth) {
      const distance = k => Math.abs(own[4 * i + k] - truth[4 * i + k]);
      value = (distance(0) + distance(1) + distance(2)) / 3 / max;
    }
    pixels[i] = PALETTE[Math.min(Math.round(value), 255)];
  }
  context.putImageData(image, 0, 0);
  return canvas;
}

for (const element of document.querySelectorAll('.player')) element.player = new Player(element);
