// @ts-check
/** As much of WebGL as the scene needs: coloured points, lines, triangles and one textured plane. */

const COLOURED = `
attribute vec3 place;
attribute vec4 colour;
uniform mat4 clip;
uniform float size;
varying vec4 shade;
void main() {
  gl_Position = clip * vec4(place, 1.0);
  gl_PointSize = clamp(size / gl_Position.w, 1.5, 7.0);
  shade = colour;
}`;
const COLOURED_PIXEL = `
precision mediump float;
varying vec4 shade;
void main() { gl_FragColor = vec4(shade.rgb * shade.a, shade.a); }`;
const TEXTURED = `
attribute vec3 place;
attribute vec2 where;
uniform mat4 clip;
varying vec2 at;
void main() {
  gl_Position = clip * vec4(place, 1.0);
  at = where;
}`;
const TEXTURED_PIXEL = `
precision mediump float;
varying vec2 at;
uniform sampler2D picture;
void main() { gl_FragColor = texture2D(picture, at); }`;

/** Vertices of seven numbers: x, y, z, then red, green, blue, alpha. */
export class Shape {
  /** @param {WebGLRenderingContext} gl @param {number} mode gl.POINTS, gl.LINES or gl.TRIANGLES */
  constructor(gl, mode) {
    this.gl = gl;
    this.mode = mode;
    this.count = 0;
    this.buffer = gl.createBuffer();
  }

  /** @param {Float32Array} vertices */
  set(vertices) {
    this.count = vertices.length / 7;
    this.gl.bindBuffer(this.gl.ARRAY_BUFFER, this.buffer);
    this.gl.bufferData(this.gl.ARRAY_BUFFER, vertices, this.gl.DYNAMIC_DRAW);
  }
}

export class Renderer {
  /** @param {WebGLRenderingContext} gl */
  constructor(gl) {
    this.gl = gl;
    this.coloured = program(gl, COLOURED, COLOURED_PIXEL, ["place", "colour"]);
    this.textured = program(gl, TEXTURED, TEXTURED_PIXEL, ["place", "where"]);
    this.plane = gl.createBuffer();
    /** @type {WebGLTexture|null} */
    this.texture = null;
    gl.enable(gl.DEPTH_TEST);
    gl.enable(gl.BLEND);
    gl.blendFunc(gl.ONE, gl.ONE_MINUS_SRC_ALPHA);
  }

  /** @param {TexImageSource|null} picture @param {number[][]} corners world, lower left and on to the left's upper */
  setPlane(picture, corners) {
    const { gl } = this;
    if (this.texture) gl.deleteTexture(this.texture);
    this.texture = null;
    if (!picture) return;
    this.texture = gl.createTexture();
    gl.bindTexture(gl.TEXTURE_2D, this.texture);
    gl.pixelStorei(gl.UNPACK_FLIP_Y_WEBGL, true);
    gl.pixelStorei(gl.UNPACK_PREMULTIPLY_ALPHA_WEBGL, true);
    gl.texImage2D(gl.TEXTURE_2D, 0, gl.RGBA, gl.RGBA, gl.UNSIGNED_BYTE, picture);
    for (const name of [gl.TEXTURE_WRAP_S, gl.TEXTURE_WRAP_T]) gl.texParameteri(gl.TEXTURE_2D, name, gl.CLAMP_TO_EDGE);
    for (const name of [gl.TEXTURE_MIN_FILTER, gl.TEXTURE_MAG_FILTER]) gl.texParameteri(gl.TEXTURE_2D, name, gl.LINEAR);
    const [a, b, c, d] = corners;
    const vertices = [...a, 0, 0, ...b, 1, 0, ...c, 1, 1, ...a, 0, 0, ...c, 1, 1, ...d, 0, 1];
    gl.bindBuffer(gl.ARRAY_BUFFER, this.plane);
    gl.bufferData(gl.ARRAY_BUFFER, new Float32Array(vertices), gl.STATIC_DRAW);
  }

  /** @param {[number, number, number]} background @param {number} width @param {number} height */
  clear(background, width, height) {
    const { gl } = this;
    gl.viewport(0, 0, width, height);
    gl.clearColor(background[0], background[1], background[2], 1);
    gl.clear(gl.COLOR_BUFFER_BIT | gl.DEPTH_BUFFER_BIT);
  }

  /** @param {Float32Array} clip */
  drawPlane(clip) {
    const { gl } = this;
    if (!this.texture) return;
    gl.useProgram(this.textured);
    gl.uniformMatrix4fv(gl.getUniformLocation(this.textured, "clip"), false, clip);
    gl.bindTexture(gl.TEXTURE_2D, this.texture);
    gl.bindBuffer(gl.ARRAY_BUFFER, this.plane);
    gl.vertexAttribPointer(0, 3, gl.FLOAT, false, 20, 0);
    gl.vertexAttribPointer(1, 2, gl.FLOAT, false, 20, 12);
    gl.drawArrays(gl.TRIANGLES, 0, 6);
  }

  /** @param {Float32Array} clip @param {Shape} shape @param {number} point_px of a point 1 m away @param {boolean} hides */
  draw(clip, shape, point_px = 1, hides = true) {
    const { gl } = this;
    if (!shape.count) return;
    gl.useProgram(this.coloured);
    gl.uniformMatrix4fv(gl.getUniformLocation(this.coloured, "clip"), false, clip);
    gl.uniform1f(gl.getUniformLocation(this.coloured, "size"), point_px);
    gl.bindBuffer(gl.ARRAY_BUFFER, shape.buffer);
    gl.vertexAttribPointer(0, 3, gl.FLOAT, false, 28, 0);
    gl.vertexAttribPointer(1, 4, gl.FLOAT, false, 28, 12);
    gl.depthMask(hides);
    gl.drawArrays(shape.mode, 0, shape.count);
    gl.depthMask(true);
  }
}

/** @param {WebGLRenderingContext} gl @param {string} vertex @param {string} pixel @param {string[]} attributes */
function program(gl, vertex, pixel, attributes) {
  const made = gl.createProgram();
  for (const [kind, source] of /** @type {[number, string][]} */ ([[gl.VERTEX_SHADER, vertex], [gl.FRAGMENT_SHADER, pixel]])) {
    const shader = gl.createShader(kind);
    if (!shader) throw new Error("no shader");
    gl.shaderSource(shader, source);
    gl.compileShader(shader);
    gl.attachShader(made, shader);
  }
  attributes.forEach((name, k) => {
    gl.bindAttribLocation(made, k, name);
    gl.enableVertexAttribArray(k);
  });
  gl.linkProgram(made);
  if (!gl.getProgramParameter(made, gl.LINK_STATUS)) throw new Error(gl.getProgramInfoLog(made) ?? "link");
  return made;
}
