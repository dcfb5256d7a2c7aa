// SPDX-License-Identifier: Apache-2.0
// Unit shapes, one across and around the origin: triangles as position and normal, six numbers a corner.

function quad(out, a, b, c, d, normals) {
  for (const i of [0, 1, 2, 0, 2, 3]) out.push(...[a, b, c, d][i], ...normals[i]);
}

export function boxMesh() {
  const out = [];
  for (let axis = 0; axis < 3; axis++) {
    for (const side of [-0.5, 0.5]) {
      const corner = (u, v) => {
        const p = [0, 0, 0];
        p[axis] = side;
        p[(axis + 1) % 3] = u * 2 * side;
        p[(axis + 2) % 3] = v;
        return p;
      };
      const n = [0, 0, 0];
      n[axis] = 2 * side;
      quad(out, corner(-0.5, -0.5), corner(0.5, -0.5), corner(0.5, 0.5), corner(-0.5, 0.5), [n, n, n, n]);
    }
  }
  return new Float32Array(out);
}

export function cylinderMesh(sides = 28) {
  const out = [];
  for (let i = 0; i < sides; i++) {
    const [a, b] = [i, i + 1].map((k) => (2 * Math.PI * k) / sides).map((t) => [Math.cos(t), Math.sin(t), 0]);
    const at = (p, z) => [p[0] / 2, p[1] / 2, z];
    quad(out, at(a, -0.5), at(b, -0.5), at(b, 0.5), at(a, 0.5), [a, b, b, a]);
    for (const z of [-0.5, 0.5]) {
      const n = [0, 0, 2 * z];
      const [p, q] = z > 0 ? [a, b] : [b, a];
      out.push(0, 0, z, ...n, ...at(p, z), ...n, ...at(q, z), ...n);
    }
  }
  return new Float32Array(out);
}

export function sphereMesh(rings = 14) {
  const out = [];
  const at = (i, k) => {
    const [polar, around] = [(Math.PI * i) / rings, (Math.PI * k) / rings];
    return [Math.sin(polar) * Math.cos(around), Math.sin(polar) * Math.sin(around), Math.cos(polar)];
  };
  const half = (p) => p.map((v) => v / 2);
  for (let i = 0; i < rings; i++) {
    for (let k = 0; k < 2 * rings; k++) {
      const n = [at(i, k), at(i + 1, k), at(i + 1, k + 1), at(i, k + 1)];
      quad(out, ...n.map(half), n);
    }
  }
  return new Float32Array(out);
}

/** The twelve edges of a box with the given pose and size, as 24 points. */
export function boxEdges(pose, size) {
  const out = [];
  const corner = (bits) => {
    const p = [0, 1, 2].map((i) => (bits & (1 << i) ? 0.5 : -0.5) * size[i]);
    return [0, 1, 2].map((r) => pose[r] * p[0] + pose[4 + r] * p[1] + pose[8 + r] * p[2] + pose[12 + r]);
  };
  for (let bits = 0; bits < 8; bits++) {
    for (const i of [1, 2, 4]) if (!(bits & i)) out.push(corner(bits), corner(bits | i));
  }
  return out;
}
