// Draws the scene by WebGPU: march.wgsl renders into a buffer of pixels, screen.wgsl draws the buffer on a canvas.
//
// A picture is drawn in strips of rows. A strip is submitted to the GPU after the previous strip is finished. So a slow
// GPU is never blocked for long, and drawing can be cancelled between two strips.
"use strict";

const STRIP = 30; // milliseconds that a strip may take
const TILE = 8; // pixels along a side of a workgroup
const PIXEL = 16; // bytes
const ELSEWHERE = "Current versions of Chrome, Edge, Safari and Firefox have it on most devices.";

class Renderer {
  // Creates a renderer. Throws an Error whose message is a sentence for the user.
  static async create(scene, data, shaders) {
    if (!navigator.gpu) {
      throw new Error(
        isSecureContext
          ? `This browser has no WebGPU. ${ELSEWHERE}`
          : "A browser gives WebGPU to pages from https, localhost or the disk only: save this page and open the file.",
      );
    }
    const adapter = await navigator.gpu.requestAdapter({ powerPreference: "high-performance" });
    if (!adapter) throw new Error(`This browser has WebGPU, but finds no GPU for it. ${ELSEWHERE}`);
    const pixels = Math.min(adapter.limits.maxStorageBufferBindingSize, adapter.limits.maxBufferSize);
    const device = await adapter.requestDevice({
      requiredLimits: { maxStorageBufferBindingSize: pixels, maxBufferSize: pixels },
    });
    const renderer = new Renderer(device, scene, Math.floor(pixels / PIXEL));
    await renderer.prepare(data, shaders);
    return renderer;
  }

  constructor(device, scene, mostPixels) {
    this.device = device;
    this.scene = scene;
    this.mostPixels = mostPixels;
    this.rows = TILE; // rows per strip, adapted to the measured time of strips
    this.pixelsPerMs = 10;
    this.hiddenCells = new Uint32Array(Math.ceil(scene.cells / 32));
    this.rough = { width: 1, height: 1, buffer: null };
    this.fine = { width: 1, height: 1, buffer: null };
  }

  async prepare(data, shaders) {
    const { device, scene } = this;
    const part = (name) => {
      const [start, size] = scene.parts[name];
      const buffer = device.createBuffer({ size, usage: GPUBufferUsage.STORAGE | GPUBufferUsage.COPY_DST });
      device.queue.writeBuffer(buffer, 0, data, start, size);
      return buffer;
    };
    const uniform = (size) => device.createBuffer({ size, usage: GPUBufferUsage.UNIFORM | GPUBufferUsage.COPY_DST });
    this.parts = ["parameters", "table", "occupied", "centres", "diagrams"].map(part);
    this.colours = part("colours");
    this.hidden = device.createBuffer({
      size: 4 * this.hiddenCells.length,
      usage: GPUBufferUsage.STORAGE | GPUBufferUsage.COPY_DST,
    });
    this.view = uniform(112);
    this.screen = uniform(48);

    const kinds = ["uniform", ...Array(6).fill("read-only-storage"), "storage"];
    const layout = (kinds, visibility) =>
      device.createBindGroupLayout({
        entries: kinds.map((type, binding) => ({ binding, visibility, buffer: { type } })),
      });
    this.marchLayout = layout(kinds, GPUShaderStage.COMPUTE);
    this.screenLayout = layout(["uniform", ...Array(3).fill("read-only-storage")], GPUShaderStage.FRAGMENT);
    const march = device.createShaderModule({ code: shaders.march });
    this.march = await device.createComputePipelineAsync({
      layout: device.createPipelineLayout({ bindGroupLayouts: [this.marchLayout] }),
      compute: { module: march, entryPoint: "draw" },
    });
    const module = device.createShaderModule({ code: shaders.screen });
    this.show = (format) =>
      device.createRenderPipelineAsync({
        layout: device.createPipelineLayout({ bindGroupLayouts: [this.screenLayout] }),
        vertex: { module, entryPoint: "corners" },
        fragment: { module, entryPoint: "show", targets: [{ format }] },
      });
    this.format = navigator.gpu.getPreferredCanvasFormat();
    this.onScreen = await this.show(this.format);
  }

  attach(canvas) {
    this.canvas = canvas;
    this.context = canvas.getContext("webgpu");
    this.context.configure({ device: this.device, format: this.format, alphaMode: "opaque" });
  }

  hide(cell, hidden) {
    const word = cell >>> 5;
    const bit = 1 << (cell & 31);
    this.hiddenCells[word] = hidden ? this.hiddenCells[word] | bit : this.hiddenCells[word] & ~bit;
  }

  isHidden(cell) {
    return ((this.hiddenCells[cell >>> 5] >>> (cell & 31)) & 1) === 1;
  }

  // Sets the size of a picture; allocates a new buffer only if the old one is too small.
  resize(target, width, height) {
    const size = PIXEL * width * height;
    if (!target.buffer || target.buffer.size < size) {
      target.buffer?.destroy();
      target.buffer = this.device.createBuffer({ size, usage: GPUBufferUsage.STORAGE | GPUBufferUsage.COPY_SRC });
    }
    target.width = width;
    target.height = height;
  }

  // Draws a picture in strips; calls `step(rows)` with the number of finished rows after each strip. Returns false if
  // `stop()` cancelled it, else true.
  // camera: {pose: 12 numbers, focal: [x, y], centre: [x, y]}, in pixels of the picture; cut: [axis, coordinate].
  async draw(target, camera, cut, step = () => {}, stop = () => false) {
    const { device } = this;
    const { width, height } = target;
    device.queue.writeBuffer(this.hidden, 0, this.hiddenCells);
    const buffers = [this.view, ...this.parts, this.hidden, target.buffer];
    const group = device.createBindGroup({
      layout: this.marchLayout,
      entries: buffers.map((buffer, binding) => ({ binding, resource: { buffer } })),
    });
    const p = camera.pose;
    const axis = (i) => [p[i], p[4 + i], p[8 + i], 0];
    const numbers = [...axis(0), ...axis(1), ...axis(2), ...axis(3), ...camera.focal, ...camera.centre];
    const view = new ArrayBuffer(112);
    new Float32Array(view).set([...numbers, 0, 0, 0, 0, cut[0], cut[1], 0, 0]);
    const began = performance.now();
    for (let first = 0; first < height; ) {
      if (stop()) return false;
      const last = Math.min(height, first + this.rows);
      new Uint32Array(view, 80, 4).set([width, height, first, last]);
      device.queue.writeBuffer(this.view, 0, view);
      const encoder = device.createCommandEncoder();
      const pass = encoder.beginComputePass();
      pass.setPipeline(this.march);
      pass.setBindGroup(0, group);
      pass.dispatchWorkgroups(Math.ceil(width / TILE), Math.ceil((last - first) / TILE));
      pass.end();
      const started = performance.now();
      device.queue.submit([encoder.finish()]);
      await device.queue.onSubmittedWorkDone();
      const took = Math.max(performance.now() - started, 0.1);
      const wanted = ((last - first) * STRIP) / took;
      this.rows = Math.max(TILE, Math.min(4 * this.rows, TILE * Math.floor(wanted / TILE), 4096));
      first = last;
      step(first);
    }
    const rate = (width * height) / Math.max(performance.now() - began, 0.1);
    this.pixelsPerMs += 0.5 * (rate - this.pixelsPerMs);
    return true;
  }

  // Shows the first `ready` rows of the sharp picture, and the coarse picture below them.
  present(look, ready) {
    const view = this.context.getCurrentTexture().createView();
    this.paint(look, ready, this.rough, this.fine, view, this.onScreen, [this.canvas.width, this.canvas.height]);
  }

  paint(look, ready, rough, fine, view, pipeline, size) {
    const { device } = this;
    const data = new ArrayBuffer(48);
    new Float32Array(data).set(size);
    const words = [rough.width, rough.height, fine.width, fine.height, ready, look.cells ? 1 : 0];
    new Uint32Array(data).set(words, 2);
    new Float32Array(data).set([...(look.background ?? [0, 0, 0]), look.background ? 1 : 0], 8);
    device.queue.writeBuffer(this.screen, 0, data);
    const buffers = [this.screen, rough.buffer, fine.buffer, this.colours];
    const encoder = device.createCommandEncoder();
    const pass = encoder.beginRenderPass({
      colorAttachments: [{ view, loadOp: "clear", storeOp: "store", clearValue: [0, 0, 0, 1] }],
    });
    pass.setPipeline(pipeline);
    pass.setBindGroup(
      0,
      device.createBindGroup({
        layout: this.screenLayout,
        entries: buffers.map((buffer, binding) => ({ binding, resource: { buffer } })),
      }),
    );
    pass.draw(3);
    pass.end();
    device.queue.submit([encoder.finish()]);
  }

  // Returns a drawn picture as RGBA bytes.
  async bytesOf(target, look) {
    const { device } = this;
    const { width, height } = target;
    const pipeline = await this.show("rgba8unorm");
    const texture = device.createTexture({
      size: [width, height],
      format: "rgba8unorm",
      usage: GPUTextureUsage.RENDER_ATTACHMENT | GPUTextureUsage.COPY_SRC,
    });
    this.paint(look, height, target, target, texture.createView(), pipeline, [width, height]);
    const bytesPerRow = Math.ceil((4 * width) / 256) * 256;
    const rows = await this.read(bytesPerRow * height, (encoder, buffer) =>
      encoder.copyTextureToBuffer({ texture }, { buffer, bytesPerRow }, [width, height]),
    );
    texture.destroy();
    const bytes = new Uint8ClampedArray(4 * width * height);
    for (let y = 0; y < height; y++) bytes.set(rows.subarray(y * bytesPerRow, y * bytesPerRow + 4 * width), 4 * width * y);
    return bytes;
  }

  // Returns the cell that a pixel of a picture shows, or -1, and its depth.
  async pick(target, x, y) {
    const at = PIXEL * (y * target.width + x);
    const bytes = await this.read(PIXEL, (encoder, buffer) =>
      encoder.copyBufferToBuffer(target.buffer, at, buffer, 0, PIXEL),
    );
    const words = new DataView(bytes.buffer);
    return { cell: words.getUint32(8, true) - 1, depth: words.getFloat32(12, true) };
  }

  async read(size, copy) {
    const buffer = this.device.createBuffer({ size, usage: GPUBufferUsage.MAP_READ | GPUBufferUsage.COPY_DST });
    const encoder = this.device.createCommandEncoder();
    copy(encoder, buffer);
    this.device.queue.submit([encoder.finish()]);
    await buffer.mapAsync(GPUMapMode.READ);
    const bytes = new Uint8Array(buffer.getMappedRange()).slice();
    buffer.destroy();
    return bytes;
  }
}
