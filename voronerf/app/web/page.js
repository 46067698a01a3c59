// The page: its camera, and the controls by mouse, touch, keys and panel.
"use strict";

const REST = 150; // milliseconds without a movement after which the sharp picture is drawn
const SMOOTH = 33; // milliseconds that a picture may take while the camera moves
const SEGMENT = 1000; // milliseconds from one camera of the path to the next
const FARTHEST = 1e6;
const NEW_DEVICES = 2; // most replacements of lost GPU devices within a minute

const element = (id) => document.getElementById(id);
const text = (id) => element(id).textContent;
const scene = JSON.parse(text("scene"));
const canvas = element("canvas");

// --- vectors ---------------------------------------------------------------------------------------------------------

const add = (a, b, scale = 1) => a.map((x, i) => x + scale * b[i]);
const dot = (a, b) => a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
const cross = (a, b) => [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]];
const unit = (a) => a.map((x) => x / (Math.hypot(...a) || 1));
const clamp = (x, low, high) => Math.min(Math.max(x, low), high);

// --- the camera ------------------------------------------------------------------------------------------------------
// A view is {target, yaw, pitch, roll, distance, wide: [width, height of the visible area at distance 1]}; z is up.

function axesOf(view) {
  const { yaw, pitch, roll } = view;
  const back = [Math.cos(pitch) * Math.cos(yaw), Math.cos(pitch) * Math.sin(yaw), Math.sin(pitch)];
  const level = [-Math.sin(yaw), Math.cos(yaw), 0];
  const right = add(level.map((x) => x * Math.cos(roll)), cross(back, level), Math.sin(roll));
  return { right, up: cross(back, right), back };
}

function viewOf(camera) {
  const column = (i) => [camera[i], camera[4 + i], camera[8 + i]];
  const [right, , back, origin] = [0, 1, 2, 3].map(column);
  const yaw = Math.atan2(back[1], back[0]);
  const level = [-Math.sin(yaw), Math.cos(yaw), 0];
  const roll = Math.atan2(dot(right, cross(back, level)), dot(right, level));
  const ahead = -dot(add(scene.target, origin, -1), back);
  const distance = Math.max(ahead, scene.near, 1e-3);
  const [focal, width, height] = camera.slice(12);
  const pitch = Math.asin(clamp(back[2], -1, 1));
  return { target: add(origin, back, -distance), yaw, pitch, roll, distance, wide: [width / focal, height / focal] };
}

// Returns the camera of a view for a picture of width x height pixels, which shows at least the area `view.wide`.
function cameraOf(view, width, height) {
  const { right, up, back } = axesOf(view);
  const origin = add(view.target, back, view.distance);
  const focal = Math.min(width / view.wide[0], height / view.wide[1]);
  const pose = [0, 1, 2].flatMap((i) => [right[i], up[i], back[i], origin[i]]);
  return { pose, focal: [focal, focal], centre: [width / 2, height / 2] };
}

const state = {
  view: viewOf(scene.first),
  cells: false,
  hidden: new Set(),
  axis: 3,
  cut: 0.5,
  background: scene.background ? "ffffff" : "000000",
  path: 0,
  playing: false,
};

// --- the view in the page's address ----------------------------------------------------------------------------------

function addressOf() {
  const { target, yaw, pitch, roll, distance, wide } = state.view;
  const parts = { v: [...target, yaw, pitch, roll, distance, ...wide].map((x) => +x.toPrecision(6)).join() };
  if (state.cells) parts.cells = 1;
  if (state.hidden.size) parts.hide = [...state.hidden].join();
  if (state.axis < 3) parts.cut = `${state.axis},${state.cut}`;
  if (state.background !== (scene.background ? "ffffff" : "000000")) parts.back = state.background || "none";
  return "#" + Object.entries(parts).map(([name, value]) => `${name}=${value}`).join("&");
}

function readAddress() {
  const parts = new URLSearchParams(location.hash.slice(1));
  const numbers = (name) => (parts.get(name) ?? "").slice(0, 10_000).split(",").map(Number);
  const v = numbers("v");
  if (v.length === 9 && v.every((x) => Math.abs(x) < FARTHEST) && Math.min(v[6], v[7], v[8]) > 0) {
    const [yaw, pitch, roll, distance] = v.slice(3);
    state.view = { target: v.slice(0, 3), yaw, pitch, roll, distance, wide: v.slice(7) };
  }
  state.cells = parts.get("cells") === "1";
  state.hidden = new Set(numbers("hide").filter((x) => parts.has("hide") && Number.isInteger(x) && x >= 0 && x < scene.cells));
  state.axis = 3;
  const [axis, cut] = numbers("cut");
  if (parts.has("cut") && [0, 1, 2].includes(axis) && cut >= 0 && cut <= 1) Object.assign(state, { axis, cut });
  const back = parts.get("back");
  if ([...element("background").options].some((option) => option.value === back)) state.background = back;
  if (back === "none") state.background = "";
}

// --- drawing ---------------------------------------------------------------------------------------------------------

let renderer = null;
let version = 1; // number of changes of the view or the panel
let drawn = 0; // the version of the sharp picture on the screen
let movedAt = 0;
let changed = () => {};
const times = []; // milliseconds of the last coarse pictures

function change() {
  version++;
  movedAt = performance.now();
  changed();
}

const look = () => {
  const hex = state.background;
  const background = hex ? [0, 2, 4].map((i) => parseInt(hex.slice(i, i + 2), 16) / 255) : null;
  return { cells: state.cells, background };
};
const cutOf = () => {
  const { axis, cut } = state;
  return axis < 3 ? [axis, scene.bounds[0][axis] + cut * (scene.bounds[1][axis] - scene.bounds[0][axis])] : [3, 0];
};
const ready = () => (drawn === version ? renderer.fine.height : 0);
const sleep = (ms) => new Promise((done) => setTimeout(done, ms));

function sizes() {
  const ratio = Math.min(devicePixelRatio || 1, Math.sqrt(renderer.mostPixels / (innerWidth * innerHeight)));
  return [Math.max(1, Math.round(innerWidth * ratio)), Math.max(1, Math.round(innerHeight * ratio))];
}

// Draws every change until another renderer replaces this one.
async function drawAlways(current) {
  for (;;) {
    if (drawn === version) await new Promise((done) => { changed = done; });
    await new Promise(requestAnimationFrame);
    if (renderer !== current) return;
    const mine = version;
    const [width, height] = sizes();
    if (canvas.width !== width || canvas.height !== height) Object.assign(canvas, { width, height });
    // While the camera moves, the resolution is reduced as far as `SMOOTH` requires.
    const share = [1, 2, 4, 8].find((s) => (width * height) / (s * s) < SMOOTH * renderer.pixelsPerMs) ?? 8;
    const began = performance.now();
    renderer.resize(renderer.rough, Math.ceil(width / share), Math.ceil(height / share));
    const { rough, fine } = renderer;
    await renderer.draw(rough, cameraOf(state.view, rough.width, rough.height), cutOf());
    if (!fine.buffer) renderer.resize(fine, 1, 1);
    renderer.present(look(), 0);
    element("still").hidden = true;
    showSpeed(performance.now() - began);
    while (version === mine && performance.now() - movedAt < REST) await sleep(20);
    if (version !== mine) continue;
    renderer.resize(fine, width, height);
    const step = (rows) => renderer.present(look(), rows);
    const whole = await renderer.draw(fine, cameraOf(state.view, width, height), cutOf(), step, () => version !== mine);
    if (!whole || renderer !== current) continue;
    drawn = mine;
    history.replaceState(null, "", addressOf());
    element("speed").value = `${width} x ${height}`;
  }
}

function showSpeed(ms) {
  times.push(ms);
  if (times.length > 12) times.shift();
  const mean = times.reduce((a, b) => a + b) / times.length;
  element("speed").value = `${(1000 / mean).toFixed(mean > 100 ? 1 : 0)} frames/s`;
}

// Draws a picture of a camera {pose: 12 numbers, focal, centre, width, height}, with the panel's settings, as RGBA bytes.
let waiting = Promise.resolve();
function picture(camera) {
  const draw = async () => {
    const target = {};
    renderer.resize(target, camera.width, camera.height);
    await renderer.draw(target, camera, cutOf());
    const bytes = await renderer.bytesOf(target, look());
    target.buffer.destroy();
    return bytes;
  };
  return (waiting = waiting.then(draw, draw));
}

async function save() {
  const [width, height] = [canvas.width, canvas.height];
  const bytes = await picture({ ...cameraOf(state.view, width, height), width, height });
  const sheet = new OffscreenCanvas(width, height);
  sheet.getContext("2d").putImageData(new ImageData(bytes, width, height), 0, 0);
  const link = document.createElement("a");
  link.href = URL.createObjectURL(await sheet.convertToBlob());
  link.download = "scene.png";
  link.click();
  setTimeout(() => URL.revokeObjectURL(link.href), 10_000);
}

// --- the panel -------------------------------------------------------------------------------------------------------

function showState() {
  element("colour").ariaPressed = String(!state.cells);
  element("cells").ariaPressed = String(state.cells);
  element("axis").value = state.axis;
  element("cut").value = state.cut;
  element("cut").disabled = state.axis > 2;
  element("background").value = state.background;
  element("play").ariaPressed = String(state.playing);
  element("play").textContent = state.playing ? "Stop" : "Play";
  element("path").value = state.path;
  const chips = [...state.hidden].map((cell) => {
    const button = document.createElement("button");
    const mark = document.createElement("i");
    mark.style.background = colourOf(cell);
    button.append(mark, `${cell}`);
    button.title = `Show cell ${cell} again`;
    button.onclick = () => hide(cell, false);
    return button;
  });
  if (chips.length > 1) {
    const all = document.createElement("button");
    all.textContent = "Show all";
    all.onclick = () => { for (const cell of [...state.hidden]) hide(cell, false); };
    chips.push(all);
  }
  element("hidden").replaceChildren(...chips);
}

let colours = null;
const colourOf = (cell) => `rgb(${colours.slice(4 * cell, 4 * cell + 3).join(" ")})`;

function hide(cell, hidden) {
  if (hidden) state.hidden.add(cell);
  else state.hidden.delete(cell);
  renderer.hide(cell, hidden);
  showState();
  change();
}

function showCells(cells) {
  state.cells = cells;
  showState();
  renderer.present(look(), ready());
  if (drawn === version) history.replaceState(null, "", addressOf());
}

function setView(view) {
  state.view = view;
  change();
}

function goTo(place) {
  const { cameras } = scene;
  state.path = place;
  const first = Math.min(Math.floor(place), cameras.length - 1);
  const next = Math.min(first + 1, cameras.length - 1);
  const share = place - first;
  const mixed = cameras[first].map((x, i) => x + share * (cameras[next][i] - x));
  const column = (i) => [mixed[i], mixed[4 + i], mixed[8 + i]];
  const back = unit(column(2));
  const right = unit(add(column(0), back, -dot(column(0), back)));
  const up = cross(back, right);
  for (let i = 0; i < 3; i++) [mixed[4 * i], mixed[4 * i + 1], mixed[4 * i + 2]] = [right[i], up[i], back[i]];
  element("path").value = place;
  setView(viewOf(mixed));
}

async function play(playing) {
  state.playing = playing;
  showState();
  let before = performance.now();
  while (state.playing) {
    await new Promise(requestAnimationFrame);
    const now = performance.now();
    const end = scene.cameras.length - 1;
    // The path advances by the elapsed time, so that a slow GPU draws fewer frames.
    if (end > 0 && state.playing) goTo((state.path + Math.min(now - before, 250) / SEGMENT) % end);
    else state.playing = false;
    before = now;
    await waiting;
  }
  showState();
}

async function pick(x, y) {
  const target = drawn === version ? renderer.fine : renderer.rough;
  const at = (value, size, count) => clamp(Math.floor((value / size) * count), 0, count - 1);
  return renderer.pick(target, at(x, innerWidth, target.width), at(y, innerHeight, target.height));
}

async function click(x, y) {
  const { cell } = await pick(x, y);
  if (cell < 0) {
    element("picked").textContent = "No cell is seen there.";
  } else if (state.cells) {
    hide(cell, true);
    element("picked").textContent = `Cell ${cell} of ${scene.cells} is hidden; its button below shows it again.`;
  } else {
    element("picked").textContent = `Cell ${cell} of ${scene.cells}. Click it in Cells to hide it.`;
  }
}

// Makes the surface point at a pixel the centre of rotation.
async function lookAt(x, y) {
  const { cell, depth } = await pick(x, y);
  if (cell < 0) return;
  const { pose, focal, centre } = cameraOf(state.view, innerWidth, innerHeight);
  const { right, up, back } = axesOf(state.view);
  const across = [(x - centre[0]) / focal[0], (y - centre[1]) / focal[1]];
  const ray = unit(add(add(back.map((b) => -b), right, across[0]), up, -across[1]));
  const target = add([pose[3], pose[7], pose[11]], ray, depth);
  const distance = Math.max(depth * -dot(ray, back), 1e-3);
  setView({ ...state.view, target, distance });
}

// --- mouse, touch and keys -------------------------------------------------------------------------------------------

function turn(right, up) {
  const { view } = state;
  setView({ ...view, yaw: view.yaw - right, pitch: clamp(view.pitch + up, -1.57, 1.57) });
}

function move(right, up) {
  const { view } = state;
  const axes = axesOf(view);
  const scale = view.distance * Math.max(view.wide[0] / innerWidth, view.wide[1] / innerHeight);
  setView({ ...view, target: add(add(view.target, axes.right, -right * scale), axes.up, up * scale) });
}

function zoom(factor) {
  setView({ ...state.view, distance: clamp(state.view.distance * factor, 1e-3, FARTHEST / 10) });
}

const pointers = new Map();
let travelled = 0;

canvas.addEventListener("pointerdown", (event) => {
  if (!renderer) return;
  canvas.setPointerCapture(event.pointerId);
  pointers.set(event.pointerId, [event.clientX, event.clientY]);
  travelled = pointers.size > 1 ? Infinity : 0;
  canvas.classList.add("held");
  if (state.playing) play(false);
});

canvas.addEventListener("pointermove", (event) => {
  const before = pointers.get(event.pointerId);
  if (!before) return;
  const now = [event.clientX, event.clientY];
  const [dx, dy] = [now[0] - before[0], now[1] - before[1]];
  travelled += Math.hypot(dx, dy);
  if (pointers.size === 1 && travelled < 4) return;
  if (pointers.size === 2) {
    const [other] = [...pointers].filter(([id]) => id !== event.pointerId).map(([, place]) => place);
    const apart = (place) => Math.hypot(place[0] - other[0], place[1] - other[1]) || 1;
    zoom(apart(before) / apart(now));
    move(dx / 2, dy / 2);
  } else if (event.buttons & 2 || event.buttons & 4 || event.shiftKey) {
    move(dx, dy);
  } else {
    turn(dx * 0.006, dy * 0.006);
  }
  pointers.set(event.pointerId, now);
});

for (const name of ["pointerup", "pointercancel"]) {
  canvas.addEventListener(name, (event) => {
    const alone = pointers.delete(event.pointerId) && pointers.size === 0;
    if (alone) canvas.classList.remove("held");
    if (alone && name === "pointerup" && travelled < 4 && event.button === 0) click(event.clientX, event.clientY);
  });
}

canvas.addEventListener("dblclick", (event) => renderer && !state.cells && lookAt(event.clientX, event.clientY));
canvas.addEventListener("contextmenu", (event) => event.preventDefault());
canvas.addEventListener("wheel", (event) => {
  event.preventDefault();
  const pixels = event.deltaY * [1, 16, 400][event.deltaMode];
  if (renderer) zoom(Math.exp(clamp(pixels, -300, 300) * 0.0015));
}, { passive: false });

const KEYS = {
  ArrowLeft: (shift) => (shift ? move(-40, 0) : turn(-0.1, 0)),
  ArrowRight: (shift) => (shift ? move(40, 0) : turn(0.1, 0)),
  ArrowUp: (shift) => (shift ? move(0, -40) : turn(0, -0.1)),
  ArrowDown: (shift) => (shift ? move(0, 40) : turn(0, 0.1)),
  "+": () => zoom(0.9),
  "=": () => zoom(0.9),
  "-": () => zoom(1 / 0.9),
  c: () => showCells(!state.cells),
  h: () => setView(viewOf(scene.first)),
  p: () => play(!state.playing),
  s: () => save(),
};

addEventListener("keydown", (event) => {
  const action = KEYS[event.key.length === 1 ? event.key.toLowerCase() : event.key];
  if (!renderer || !action || event.ctrlKey || event.metaKey || event.altKey) return;
  if (event.target.closest?.("input, select")) return;
  event.preventDefault();
  action(event.shiftKey);
});

function wire() {
  const on = (id, name, action) => element(id).addEventListener(name, action);
  on("colour", "click", () => showCells(false));
  on("cells", "click", () => showCells(true));
  on("axis", "change", (event) => {
    state.axis = Number(event.target.value);
    showState();
    change();
  });
  on("cut", "input", (event) => {
    state.cut = Number(event.target.value);
    change();
  });
  on("background", "change", (event) => {
    state.background = event.target.value;
    renderer.present(look(), ready());
    if (drawn === version) history.replaceState(null, "", addressOf());
  });
  on("play", "click", () => play(!state.playing));
  on("path", "input", (event) => {
    state.playing = false;
    goTo(Number(event.target.value));
  });
  on("home", "click", () => setView(viewOf(scene.first)));
  on("save", "click", save);
  on("link", "click", async () => {
    history.replaceState(null, "", addressOf());
    try {
      await navigator.clipboard.writeText(location.href);
      element("picked").textContent = "The link to this view is copied.";
    } catch {
      element("picked").textContent = "The address of the page is the link to this view.";
    }
  });
  addEventListener("resize", change);
  addEventListener("hashchange", () => {
    readAddress();
    for (let cell = 0; cell < scene.cells; cell++) renderer.hide(cell, state.hidden.has(cell));
    showState();
    change();
  });
}

// --- the start -------------------------------------------------------------------------------------------------------

async function unpacked() {
  const packed = Uint8Array.from(atob(text("data")), (letter) => letter.charCodeAt(0));
  element("data").remove();
  const stream = new Blob([packed]).stream().pipeThrough(new DecompressionStream("deflate"));
  const data = new Uint8Array(await new Response(stream).arrayBuffer());
  if (data.length !== scene.bytes) throw new Error("The page is damaged: a part of it is missing.");
  return data;
}

function fold(open) {
  element("panel").hidden = !open;
  element("fold").ariaExpanded = String(open);
  document.querySelector("header").classList.toggle("open", open);
}

async function start() {
  element("name").textContent = scene.name;
  element("path").max = Math.max(scene.cameras.length - 1, 0);
  element("fold").addEventListener("click", () => fold(element("panel").hidden));
  fold(false);
  const data = await unpacked();
  const [first] = scene.parts.colours;
  colours = data.subarray(first, first + 4 * scene.cells);
  readAddress();
  await open(data);
  wire();
  showState();
  fold(innerWidth > 600);
}

async function open(data) {
  const current = await Renderer.create(scene, data, { march: text("march"), screen: text("screen") });
  current.attach(canvas);
  for (const cell of state.hidden) current.hide(cell, true);
  renderer = current;
  drawn = 0;
  const lost = current.device.lost.then(({ message }) => message);
  const failed = drawAlways(current).catch(({ message }) => message);
  Promise.race([lost, failed]).then((reason) => reopen(data, reason)).catch(fail);
}

// A browser may take the GPU device away: from a page in the background, after a driver crash, or for lack of memory.
const losses = []; // times of the losses in milliseconds
async function reopen(data, reason) {
  losses.push(performance.now());
  if (losses.at(-1) - losses.at(-1 - NEW_DEVICES) < 60_000) {
    throw new Error(`The browser took the GPU away ${NEW_DEVICES + 1} times in a minute. Reload the page to try again.`);
  }
  console.warn(`A new GPU device replaces one that is lost: ${reason}`);
  await sleep(500); // the browser may have to restart its GPU process
  await open(data);
}

function fail(error) {
  renderer = null;
  element("still").hidden = false;
  fold(false);
  element("fold").hidden = true;
  element("note").textContent = `${error.message} This is how the scene looks.`;
  console.error(error);
}

globalThis.voronerf = { picture, started: start().catch(fail) };
