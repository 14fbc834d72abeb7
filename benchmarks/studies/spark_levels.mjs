// Writes the levels of Spark's quality tree at several numbers of gaussians, as .ply files for the part "merging" of
// the evaluation:
//   npm install @sparkjsdev/spark@2.2.0 && node spark_levels.mjs donut.ply peers 50 25 12.5 6.25 1
// Spark's worker and its compiled tree run unchanged in Node, without a browser. The tree selects nodes for a camera
// that is very far away, so that all parts of the asset count equally. Merged nodes may have opacities above 1, for
// which Spark has a special falloff; here they are clamped. The script prints seconds.json, in which each level has
// the seconds of the single build.
import fs from "node:fs";
import path from "node:path";
import vm from "node:vm";

const [asset, folder, ...percents] = process.argv.slice(2);
const entry = path.join(process.cwd(), "node_modules/@sparkjsdev/spark/dist/spark.module.js");
const source = fs.readFileSync(entry, "utf8");

// The worker's program is a string constant in the module. The compiled part is its first WebAssembly, in base64.
const worker = vm.runInThisContext(source.match(/const jsContent = ('(?:[^'\\]|\\.)*')/s)[1]);
const wasm = Buffer.from(source.match(/"(AGFzbQ[A-Za-z0-9+/=]*)"/)[1], "base64");
const waiting = new Map();
let listener;
Object.assign(globalThis, {
  self: globalThis,
  addEventListener: (kind, call) => { if (kind === "message") listener = call; },
  removeEventListener: () => {},
  postMessage: (message) => {
    const { resolve, reject } = waiting.get(message.id) ?? {};
    if (message.error) reject?.(message.error);
    else if (message.result !== undefined) resolve?.(message.result);
  },
});
console.log = console.error; // the worker logs its progress; standard output is for the result
vm.runInThisContext(worker);

let calls = 0;
function call(name, args) {
  const id = ++calls;
  const answer = new Promise((resolve, reject) => waiting.set(id, { resolve, reject }));
  listener({ data: { id, name, args } });
  return answer;
}

// Returns the source of a function of the module, because the module does not export it.
function take(name) {
  const start = source.indexOf(`function ${name}(`);
  let end = source.indexOf("{", start), depth = 0;
  do depth += { "{": 1, "}": -1 }[source[end++]] ?? 0; while (depth);
  return source.slice(start, end);
}

const half = (bits) => {
  const sign = bits & 0x8000 ? -1 : 1, exponent = (bits >> 10) & 31, mantissa = bits & 1023;
  if (exponent === 0) return sign * mantissa * 2 ** -24;
  return exponent === 31 ? sign * (mantissa ? NaN : Infinity) : sign * (1 + mantissa / 1024) * 2 ** (exponent - 15);
};
const decodeQuaternion = vm.runInThisContext(`(${take("decodeQuatOctXy1010R12")})`);

listener({ data: { name: "init-wasm", id: 0, module: new WebAssembly.Module(wasm) } });
await new Promise((resolve) => setTimeout(resolve, 200));
const start = performance.now();
const { lodSplats } = await call("loadExtSplats", {
  fileBytes: new Uint8Array(fs.readFileSync(asset)), fileType: "ply", pathName: "asset.ply", lod: "quality", nonLod: true,
});
const seconds = (performance.now() - start) / 1000;
const [a, b] = lodSplats.extArrays.map((array) => new Uint32Array(array.buffer, array.byteOffset, array.length));
const positions = new Float32Array(a.buffer, a.byteOffset, a.length);
const low = [Infinity, Infinity, Infinity], high = [-Infinity, -Infinity, -Infinity];
for (let i = 0; i < lodSplats.numSplats; ++i)
  for (let k = 0; k < 3; ++k) {
    low[k] = Math.min(low[k], positions[4 * i + k]);
    high[k] = Math.max(high[k], positions[4 * i + k]);
  }
const away = 20 * Math.hypot(...high.map((x, k) => x - low[k]));
const eye = low.map((x, k) => (x + high[k]) / 2 + (k === 2 ? away : 0)); // the camera looks along -z
const { lodId } = await call("initLodTree", { numSplats: lodSplats.numSplats, lodTree: lodSplats.extra.lodTree });

const names = ["x", "y", "z", "f_dc_0", "f_dc_1", "f_dc_2", "opacity", "scale_0", "scale_1", "scale_2", "rot_0", "rot_1", "rot_2", "rot_3"];
const vertices = Number(fs.readFileSync(asset).subarray(0, 4096).toString("latin1").match(/element vertex (\d+)/)[1]);
const stem = path.basename(asset, ".ply");
for (const percent of percents) {
  const { keyIndices } = await call("traverseLodTrees", {
    maxSplats: Math.round(vertices * percent / 100), pixelScaleLimit: 0, traverseMode: "standard",
    instances: { 0: { instanceId: 0, lodId, viewToObjectCols: [1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, ...eye, 1], lodScale: 1,
      behindFoveate: 1, coneFov0: 0, coneFov: 0, coneFoveate: 1 } },
  });
  const chosen = keyIndices[0].indices.subarray(0, keyIndices[0].numSplats);
  const rows = new Float32Array(names.length * chosen.length);
  chosen.forEach((i, row) => {
    const q = { set(x, y, z, w) { Object.assign(this, { x, y, z, w }); return this; } };
    decodeQuaternion(b[4 * i + 3], q);
    const opacity = Math.min(0.999, Math.max(1e-4, half(a[4 * i + 3] & 65535)));
    const color = [b[4 * i] & 65535, b[4 * i] >>> 16, b[4 * i + 1] & 65535].map((c) => (half(c) - 0.5) / 0.28209479177387814);
    const scale = [b[4 * i + 1] >>> 16, b[4 * i + 2] & 65535, b[4 * i + 2] >>> 16].map(half);
    const place = positions.subarray(4 * i, 4 * i + 3);
    rows.set([...place, ...color, Math.log(opacity / (1 - opacity)), ...scale, q.w, q.x, q.y, q.z], row * names.length);
  });
  const header = ["ply", "format binary_little_endian 1.0", `element vertex ${chosen.length}`,
    ...names.map((name) => `property float ${name}`), "end_header", ""].join("\n");
  fs.writeFileSync(path.join(folder, `${stem}_spark_${percent}.ply`), Buffer.concat([Buffer.from(header), Buffer.from(rows.buffer)]));
}
process.stdout.write(JSON.stringify({ spark: Object.fromEntries(percents.map((p) => [p, seconds])) }) + "\n");
process.exit(0);
