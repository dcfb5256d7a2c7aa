// SPDX-License-Identifier: Apache-2.0
// 4×4 matrices as arrays of 16 numbers by columns, and vectors of three.

export const sub = (a, b) => [a[0] - b[0], a[1] - b[1], a[2] - b[2]];
export const dot = (a, b) => a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
export const cross = (a, b) => [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]];

export function unit(a) {
  const n = Math.hypot(...a);
  return a.map((v) => v / n);
}

export function multiply(a, b, out = new Float32Array(16), at = 0, from = 0) {
  for (let c = 0; c < 4; c++) {
    for (let r = 0; r < 4; r++) {
      let sum = 0;
      for (let k = 0; k < 4; k++) sum += a[from + 4 * k + r] * b[4 * c + k];
      out[at + 4 * c + r] = sum;
    }
  }
  return out;
}

export function scaled(m, x, y, z) {
  return Float32Array.from(m, (v, i) => v * (i < 4 ? x : i < 8 ? y : i < 12 ? z : 1));
}

export function perspective(fovy, aspect, near, far) {
  const f = 1 / Math.tan(fovy / 2);
  const depth = near - far;
  return new Float32Array([f / aspect, 0, 0, 0, 0, f, 0, 0, 0, 0, (far + near) / depth, -1, 0, 0, (2 * far * near) / depth, 0]);
}

export function lookAt(eye, target, up) {
  const z = unit(sub(eye, target));
  const x = unit(cross(up, z));
  const y = cross(z, x);
  return new Float32Array([x[0], y[0], z[0], 0, x[1], y[1], z[1], 0, x[2], y[2], z[2], 0, -dot(x, eye), -dot(y, eye), -dot(z, eye), 1]);
}

export function project(m, p) {
  const row = (r) => m[r] * p[0] + m[4 + r] * p[1] + m[8 + r] * p[2] + m[12 + r];
  const w = row(3);
  return w > 0 ? [row(0) / w, row(1) / w] : null;
}
