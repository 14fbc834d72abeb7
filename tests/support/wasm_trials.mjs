// Runs trials of test_wasm.py with the module of WebAssembly:
//   node wasm_trials.mjs CORE.mjs MODULE.wasm FOLDER
// FOLDER has arrays.bin and trials.json, which refers to arrays as [type, first byte,
// length]. The results go to cuts.bin and rows.bin there.

import { readFileSync, writeFileSync } from "node:fs";
import { join } from "node:path";
import { pathToFileURL } from "node:url";

const [coreFile, moduleFile, folder] = process.argv.slice(2);
const { Bundle, Core, Scene } = await import(pathToFileURL(coreFile).href);
const TYPES = { BigInt64Array, Float32Array, Float64Array, Int32Array, Uint32Array, Uint8Array };
const trials = JSON.parse(readFileSync(join(folder, "trials.json"), "utf8"));
const { buffer } = new Uint8Array(readFileSync(join(folder, "arrays.bin")));

const array = (place) => (place === null ? null : new TYPES[place[0]](buffer, place[1], place[2]));
const arrays = (places) =>
  Object.fromEntries(Object.entries(places).map(([name, place]) => [name, array(place)]));

const core = await Core.load(readFileSync(moduleFile));
const bundles = trials.bundles.map((tables) => new Bundle(core, arrays(tables)));
const parts = [];
const started = performance.now();
let numCuts = 0;
for (const { used, instances, views } of trials.scenes) {
  const scene = new Scene(
    core,
    used.map((index) => bundles[index]),
  );
  scene.setInstances(arrays(instances));
  for (const view of views) {
    const tolerance = view.tolerance ?? Infinity;
    const cut = scene.select({ ...view, tolerance });
    numCuts += 1;
    const head = new DataView(new ArrayBuffer(12));
    head.setUint32(0, cut.fitsBudget ? 1 : 0, true);
    head.setUint32(4, cut.fitsBudget ? cut.instance.length : cut.numGaussians, true);
    head.setFloat32(8, cut.fitsBudget ? cut.tolerance : 0, true);
    for (const values of [head, cut.instance, cut.cluster, cut.weight]) {
      if (values !== null) parts.push(Buffer.from(values.buffer));
    }
  }
  scene.free();
}
const seconds = (performance.now() - started) / 1000;
writeFileSync(join(folder, "cuts.bin"), Buffer.concat(parts));

const rows = [];
for (const { offset, bytes, degree } of trials.pages) {
  const page = array(bytes);
  rows.push(Buffer.from(core.hash(page)));
  const decoded = core.decodePage(array(offset), page, degree);
  Object.values(decoded).forEach((values) => rows.push(Buffer.from(values.buffer)));
}
writeFileSync(join(folder, "rows.bin"), Buffer.concat(rows));
let refused = "nothing";
if (trials.damaged) {
  const { offset, bytes, degree } = trials.damaged;
  try {
    core.decodePage(array(offset), array(bytes), degree);
  } catch (error) {
    refused = error.message;
  }
}
bundles.forEach((bundle) => bundle.free());
console.log(JSON.stringify({ numCuts, seconds, refused }));
