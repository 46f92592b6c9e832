// Rendering of the same buffers as picture, picking buffer (feature numbers) and shadow map.

const SKY = [0.725, 0.812, 0.894, 1];
const SUN_PIXELS = 2048;
const FAR_PIXELS = 12; // smaller copies are drawn as `farShape`s
const LEAST_PIXELS = 0.3; // copies whose second side is smaller are not drawn

class Renderer {
  constructor(canvas, head, shapes) {
    const gl = contextOf(canvas);
    Object.assign(this, { canvas, gl, head, tiles: [], made: [], bytes: 0, mode: 0, selected: -1, glow: 0, shadows: false, guesses: true, sunAzimuth: 2.6 });
    this.hidden = new Set();
    this.programs = {};
    for (const pass of ["VIEW", "PICK", "DEPTH"])
      this.programs[pass] = [programOf(gl, VERTEX, FRAGMENT, pass), programOf(gl, VERTEX, FRAGMENT, pass, "COPIES")];
    const onCard = (shape) => ({
      bytes: this.buffer(vertexBytes(shape, 1)), positions: this.buffer(shapePositions(shape)), count: shape.corners.length,
    });
    this.shapes = shapes.map((shape) => ({ shape, near: onCard(shape), far: onCard(farShape(shape)) }));
    this.codes = this.texture();
    const codes = new Uint8Array(256 * 2 * 4);
    for (const [code, [, rgb]] of Object.entries(head.materials)) codes.set(rgb, 4 * code);
    for (const [code, [, rgb]] of Object.entries(head.classes)) codes.set(rgb, 1024 + 4 * code);
    gl.texImage2D(gl.TEXTURE_2D, 0, gl.RGBA8, 256, 2, 0, gl.RGBA, gl.UNSIGNED_BYTE, codes);
    this.featureColors = this.texture();
    this.colorFeatures(() => null);
    this.makeSun();
    this.numbers = gl.createFramebuffer();
    this.stale = true; // the picking buffer
    gl.enable(gl.DEPTH_TEST);
    gl.enable(gl.CULL_FACE);
  }

  buffer(data) {
    const { gl } = this;
    const buffer = gl.createBuffer();
    this.made.push(() => gl.deleteBuffer(buffer));
    this.bytes += data.byteLength;
    gl.bindBuffer(gl.ARRAY_BUFFER, buffer);
    gl.bufferData(gl.ARRAY_BUFFER, data, gl.STATIC_DRAW);
    return buffer;
  }

  texture() {
    const { gl } = this;
    const texture = gl.createTexture();
    gl.bindTexture(gl.TEXTURE_2D, texture);
    for (const name of [gl.TEXTURE_MIN_FILTER, gl.TEXTURE_MAG_FILTER]) gl.texParameteri(gl.TEXTURE_2D, name, gl.NEAREST);
    for (const name of [gl.TEXTURE_WRAP_S, gl.TEXTURE_WRAP_T]) gl.texParameteri(gl.TEXTURE_2D, name, gl.CLAMP_TO_EDGE);
    return texture;
  }

  makeSun() {
    const { gl } = this;
    this.sunDepth = this.texture();
    gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_COMPARE_MODE, gl.COMPARE_REF_TO_TEXTURE);
    for (const name of [gl.TEXTURE_MIN_FILTER, gl.TEXTURE_MAG_FILTER]) gl.texParameteri(gl.TEXTURE_2D, name, gl.LINEAR);
    gl.texStorage2D(gl.TEXTURE_2D, 1, gl.DEPTH_COMPONENT24, SUN_PIXELS, SUN_PIXELS);
    this.sunFrame = gl.createFramebuffer();
    gl.bindFramebuffer(gl.FRAMEBUFFER, this.sunFrame);
    gl.framebufferTexture2D(gl.FRAMEBUFFER, gl.DEPTH_ATTACHMENT, gl.TEXTURE_2D, this.sunDepth, 0);
    gl.drawBuffers([gl.NONE]);
    gl.bindFramebuffer(gl.FRAMEBUFFER, null);
  }

  /** A new array of attributes, bound. */
  array() {
    const { gl } = this;
    const array = gl.createVertexArray();
    this.made.push(() => gl.deleteVertexArray(array));
    gl.bindVertexArray(array);
    return array;
  }

  /** Put a tile's faces and copies on the card; it is drawn while it is among `tiles`. */
  add(told, tile) {
    const { gl } = this;
    Object.assign(this, { made: [], bytes: 0 });
    const faces = this.array();
    this.buffer(vertexBytes(tile, told.step));
    this.perVertex(true);
    const walled = this.walled(told, tile);
    const runs = [];
    const transforms = this.buffer(tile.transform), features = this.buffer(tile.copied);
    let first = 0;
    for (const [group, number, count] of told.runs) {
      const { shape, near, far } = this.shapes[number];
      const [nearArray, farArray] = [near, far].map((drawn) => this.copies(drawn, transforms, features, first));
      runs.push({
        group, count, sides: sidesOf(shape, tile.transform, first, count),
        near: { array: nearArray, vertices: near.count }, far: { array: farArray, vertices: far.count },
      });
      first += count;
    }
    gl.bindVertexArray(null);
    return { told, faces, walled, runs, origin: told.base.map((b) => b * told.step), made: this.made, bytes: this.bytes };
  }

  /** Take what `add` returned from the card. */
  remove({ made }) {
    made.forEach((undo) => undo());
  }

  /** The faces of buildings, with the columns of walls; null if there are none. */
  walled(told, tile) {
    const { gl, head } = this;
    const group = head.groups.indexOf("buildings"), first = group > 0 ? told.ends[group - 1] : 0;
    if (group < 0 || told.ends[group] === first) return null;
    const bytes = gl.getParameter(gl.ARRAY_BUFFER_BINDING), array = this.array();
    gl.bindBuffer(gl.ARRAY_BUFFER, bytes);
    this.perVertex(true, 3 * first * VERTEX_BYTES);
    this.buffer(wallBytes(tile, told, first, told.ends[group]));
    for (const place of [8, 9]) gl.enableVertexAttribArray(place);
    gl.vertexAttribPointer(8, 4, gl.UNSIGNED_SHORT, false, WALL_BYTES, 0);
    gl.vertexAttribPointer(9, 4, gl.UNSIGNED_BYTE, false, WALL_BYTES, 8);
    return { group, array };
  }

  /** Attributes of copies, from the first on. */
  copies(shape, transforms, features, first) {
    const { gl } = this;
    const array = this.array();
    gl.bindBuffer(gl.ARRAY_BUFFER, shape.bytes);
    this.perVertex(false);
    gl.bindBuffer(gl.ARRAY_BUFFER, shape.positions);
    gl.enableVertexAttribArray(0);
    gl.vertexAttribPointer(0, 3, gl.FLOAT, false, 0, 0);
    gl.bindBuffer(gl.ARRAY_BUFFER, transforms);
    for (let row = 0; row < 3; row++) {
      gl.enableVertexAttribArray(5 + row);
      gl.vertexAttribPointer(5 + row, 4, gl.FLOAT, false, 48, 48 * first + 16 * row);
      gl.vertexAttribDivisor(5 + row, 1);
    }
    gl.bindBuffer(gl.ARRAY_BUFFER, features);
    gl.enableVertexAttribArray(1);
    gl.vertexAttribIPointer(1, 1, gl.INT, 4, 4 * first);
    gl.vertexAttribDivisor(1, 1);
    return array;
  }

  /** Attributes of the bound buffer that `vertexBytes` made; those of tiles with position and feature. */
  perVertex(tile, start = 0) {
    const { gl } = this;
    if (tile) {
      gl.enableVertexAttribArray(0);
      gl.vertexAttribIPointer(0, 3, gl.UNSIGNED_SHORT, VERTEX_BYTES, start);
      gl.enableVertexAttribArray(1);
      gl.vertexAttribIPointer(1, 1, gl.INT, VERTEX_BYTES, start + 8);
    }
    for (const k of [2, 3, 4]) gl.enableVertexAttribArray(k);
    gl.vertexAttribPointer(2, 3, gl.BYTE, true, VERTEX_BYTES, start + 12);
    gl.vertexAttribIPointer(3, 3, gl.UNSIGNED_BYTE, VERTEX_BYTES, start + 16);
    gl.vertexAttribPointer(4, 3, gl.UNSIGNED_BYTE, true, VERTEX_BYTES, start + 20);
  }

  /** Give each feature its colour for mode 3; grey where `colorOf` gives null. */
  colorFeatures(colorOf) {
    const { gl, head } = this;
    const rows = Math.ceil((head.features + 1) / 4096);
    const data = new Uint8Array(4096 * rows * 4);
    for (let f = -1; f < head.features; f++) data.set(colorOf(f) || [172, 176, 180], 4 * (f + 1));
    gl.bindTexture(gl.TEXTURE_2D, this.featureColors);
    gl.texImage2D(gl.TEXTURE_2D, 0, gl.RGBA8, 4096, rows, 0, gl.RGBA, gl.UNSIGNED_BYTE, data);
  }

  /** Draw what is not hidden and may be in view. */
  draw(pass, matrix, camera) {
    const { gl, head } = this;
    const { target } = camera, eye = camera.eye(), pixel = camera.pixel(this.canvas.clientHeight) / camera.distance;
    const seen = this.tiles
      .map((tile) => ({ ...tile, offset: tile.origin.map((v, k) => v - target[k]) }))
      .filter(({ told }) => boxSeen(matrix, told.low.map((v, k) => v - target[k]), told.high.map((v, k) => v - target[k])));
    this.programs[pass].forEach(({ program, at }, copies) => {
      gl.useProgram(program);
      gl.uniformMatrix4fv(at.uMatrix, false, matrix);
      gl.uniform1i(at.uMode, this.mode);
      gl.uniform1i(at.uGuesses, this.guesses ? 1 : 0);
      gl.uniform1i(at.uCodes, 0);
      gl.uniform1i(at.uFeatures, 1);
      gl.uniform1i(at.uSunDepth, 2);
      gl.uniform3fv(at.uSun, this.sun());
      gl.uniform1i(at.uSelected, this.selected);
      gl.uniform1f(at.uGlow, this.glow);
      gl.uniform1i(at.uShadows, this.shadows ? 1 : 0);
      gl.uniform1f(at.uSunPixel, this.sunPixel || 0);
      if (at.uSunMatrix) gl.uniformMatrix4fv(at.uSunMatrix, false, this.sunMatrix || new Float32Array(16));
      for (const { told, coarse, faces, walled, runs, offset } of seen) {
        gl.uniform3fv(at.uOffset, offset);
        if (copies) {
          const metres = pixel * Math.hypot(...eye.map((v, k) => v - Math.min(told.high[k], Math.max(told.low[k], v))));
          for (const { group, sides, near, far, count } of runs) {
            if (this.hidden.has(head.groups[group]) || sides[1] < LEAST_PIXELS * metres) continue;
            const drawn = (coarse || sides[0] < FAR_PIXELS * metres) && far.vertices < near.vertices ? far : near;
            gl.bindVertexArray(drawn.array);
            gl.drawArraysInstanced(gl.TRIANGLES, 0, drawn.vertices, count);
          }
          continue;
        }
        gl.uniform1f(at.uStep, told.step);
        told.ends.forEach((end, group) => {
          const start = group ? told.ends[group - 1] : 0;
          if (end <= start || this.hidden.has(head.groups[group])) return;
          const own = walled && walled.group === group;
          gl.bindVertexArray(own ? walled.array : faces);
          gl.drawArrays(gl.TRIANGLES, own ? 0 : 3 * start, 3 * (end - start));
        });
      }
    });
  }

  /** Unit vector towards the sun, 40 degrees high. */
  sun() {
    const high = 0.7;
    return [Math.sin(this.sunAzimuth) * Math.cos(high), Math.cos(this.sunAzimuth) * Math.cos(high), Math.sin(high)];
  }

  /** The picture. */
  render(camera) {
    const { gl, canvas } = this;
    const ratio = Math.min(window.devicePixelRatio || 1, 2);
    const [width, height] = [Math.round(canvas.clientWidth * ratio), Math.round(canvas.clientHeight * ratio)];
    if (canvas.width !== width || canvas.height !== height) [canvas.width, canvas.height] = [width, height];
    gl.activeTexture(gl.TEXTURE0);
    gl.bindTexture(gl.TEXTURE_2D, this.codes);
    gl.activeTexture(gl.TEXTURE1);
    gl.bindTexture(gl.TEXTURE_2D, this.featureColors);
    gl.activeTexture(gl.TEXTURE2);
    gl.bindTexture(gl.TEXTURE_2D, null);
    if (this.shadows) this.renderSun(camera);
    gl.bindTexture(gl.TEXTURE_2D, this.sunDepth);
    gl.activeTexture(gl.TEXTURE0);
    gl.bindFramebuffer(gl.FRAMEBUFFER, null);
    gl.viewport(0, 0, width, height);
    gl.clearColor(...SKY);
    gl.clear(gl.COLOR_BUFFER_BIT | gl.DEPTH_BUFFER_BIT);
    this.draw("VIEW", camera.matrix(width / height), camera);
    this.stale = true;
  }

  /** What the sun sees of the surroundings of the target. */
  renderSun(camera) {
    const { gl, head } = this;
    const sun = this.sun();
    const whole = Math.hypot(...head.high.map((h, k) => h - head.low[k]));
    const half = Math.min(1.3 * camera.distance, whole), deep = half + 2 * (head.high[2] - head.low[2]) + 50;
    this.sunPixel = (2 * half) / SUN_PIXELS;
    const right = [Math.cos(this.sunAzimuth), -Math.sin(this.sunAzimuth), 0];
    const up = [sun[1] * right[2] - sun[2] * right[1], sun[2] * right[0] - sun[0] * right[2], sun[0] * right[1] - sun[1] * right[0]];
    const box = new Float32Array([1 / half, 0, 0, 0, 0, 1 / half, 0, 0, 0, 0, -1 / deep, 0, 0, 0, 0, 1]);
    this.sunMatrix = product(box, toAxes(right, up, sun, [0, 0, 0]));
    gl.bindFramebuffer(gl.FRAMEBUFFER, this.sunFrame);
    gl.viewport(0, 0, SUN_PIXELS, SUN_PIXELS);
    gl.clear(gl.DEPTH_BUFFER_BIT);
    this.draw("DEPTH", this.sunMatrix, camera);
  }

  /** What lies under a point of the canvas: feature, class, material, surface and point; null for the sky. */
  pick(camera, x, y) {
    const { gl, canvas } = this;
    const [width, height] = [canvas.clientWidth, canvas.clientHeight];
    if (x < 0 || y < 0 || x >= width || y >= height) return null;
    gl.bindFramebuffer(gl.FRAMEBUFFER, this.numbers);
    if (this.stale) this.renderNumbers(camera, width, height);
    const number = new Uint32Array(4), code = new Uint32Array(4);
    for (const [k, values] of [number, code].entries()) {
      gl.readBuffer(gl.COLOR_ATTACHMENT0 + k);
      gl.readPixels(Math.floor(x), height - 1 - Math.floor(y), 1, 1, gl.RGBA_INTEGER, gl.UNSIGNED_INT, values);
    }
    gl.bindFramebuffer(gl.FRAMEBUFFER, null);
    if (number[0] === 0) return null;
    const relative = [...new Float32Array(number.buffer, 4, 3)];
    return {
      feature: number[0] - 2, klass: code[0] & 255, material: (code[0] >> 8) & 255, surface: (code[0] >> 16) & SIDE,
      guessed: Boolean((code[0] >> 16) & GUESSED),
      relative, point: relative.map((v, k) => v + camera.target[k]),
    };
  }

  renderNumbers(camera, width, height) {
    const { gl } = this;
    if (this.numberSize !== `${width}x${height}`) {
      this.numberSize = `${width}x${height}`;
      for (const old of this.numberBuffers || []) gl.deleteRenderbuffer(old);
      const kinds = [[gl.RGBA32UI, gl.COLOR_ATTACHMENT0], [gl.R32UI, gl.COLOR_ATTACHMENT1], [gl.DEPTH_COMPONENT24, gl.DEPTH_ATTACHMENT]];
      this.numberBuffers = kinds.map(([format, place]) => {
        const buffer = gl.createRenderbuffer();
        gl.bindRenderbuffer(gl.RENDERBUFFER, buffer);
        gl.renderbufferStorage(gl.RENDERBUFFER, format, width, height);
        gl.framebufferRenderbuffer(gl.FRAMEBUFFER, place, gl.RENDERBUFFER, buffer);
        return buffer;
      });
      gl.drawBuffers([gl.COLOR_ATTACHMENT0, gl.COLOR_ATTACHMENT1]);
    }
    gl.viewport(0, 0, width, height);
    gl.clearBufferuiv(gl.COLOR, 0, new Uint32Array(4));
    gl.clearBufferuiv(gl.COLOR, 1, new Uint32Array(4));
    gl.clear(gl.DEPTH_BUFFER_BIT);
    this.draw("PICK", camera.matrix(width / height), camera);
    this.stale = false;
  }
}

/** Whether a box may be in view: not all of its corners are beyond the same plane. */
function boxSeen(m, low, high) {
  const out = [0, 0, 0, 0, 0, 0];
  for (let k = 0; k < 8; k++) {
    const [x, y, z] = [0, 1, 2].map((axis) => ((k >> axis) & 1 ? high : low)[axis]);
    const w = m[3] * x + m[7] * y + m[11] * z + m[15];
    for (let axis = 0; axis < 3; axis++) {
      const v = m[axis] * x + m[4 + axis] * y + m[8 + axis] * z + m[12 + axis];
      out[2 * axis] += v < -w;
      out[2 * axis + 1] += v > w;
    }
  }
  return !out.includes(8);
}
