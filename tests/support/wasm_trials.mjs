// Runs trials of test_wasm.py with the core in WebAssembly, in Node.js and in pages.
// `trials` refers to arrays in a buffer as [type, first byte, length].

const TYPES = { BigInt64Array, Float32Array, Float64Array, Int32Array, Uint32Array, Uint8Array };

/** Return the bytes of several arrays, one after another. */
function joined(arrays) {
  const parts = arrays.map(
    (array) => new Uint8Array(array.buffer, array.byteOffset, array.byteLength),
  );
  const bytes = new Uint8Array(parts.reduce((sum, part) => sum + part.length, 0));
  let end = 0;
  for (const part of parts) {
    bytes.set(part, end);
    end += part.length;
  }
  return bytes;
}

function bytesOfCut(cut) {
  const head = new DataView(new ArrayBuffer(12));
  head.setUint32(0, cut.fitsBudget ? 1 : 0, true);
  head.setUint32(4, cut.fitsBudget ? cut.instance.length : cut.numGaussians, true);
  head.setFloat32(8, cut.fitsBudget ? cut.tolerance : 0, true);
  return joined([head, cut.instance, cut.cluster, cut.weight].filter((values) => values !== null));
}

/**
 * Run all trials. Return the bytes of the cuts and of the decoded pages, and a report.
 * @param {object} module The exports of core.js.
 * @param {BufferSource} code The compiled core.
 */
export async function runTrials({ Bundle, Core, Scene }, code, trials, buffer) {
  const array = (place) =>
    place === null ? null : new TYPES[place[0]](buffer, place[1], place[2]);
  const arrays = (places) =>
    Object.fromEntries(Object.entries(places).map(([name, place]) => [name, array(place)]));

  const core = await Core.load(code);
  const bundles = trials.bundles.map((tables) => new Bundle(core, arrays(tables)));
  const cuts = [];
  const started = performance.now();
  for (const { used, instances, views } of trials.scenes) {
    const scene = new Scene(
      core,
      used.map((index) => bundles[index]),
    );
    scene.setInstances(arrays(instances));
    for (const view of views) {
      const tolerance = view.tolerance ?? Infinity;
      cuts.push(bytesOfCut(scene.select({ ...view, tolerance })));
    }
    scene.free();
  }
  const seconds = (performance.now() - started) / 1000;

  const rows = [];
  for (const { offset, bytes, degree } of trials.pages) {
    const page = array(bytes);
    rows.push(core.hash(page));
    rows.push(...Object.values(core.decodePage(array(offset), page, degree)));
  }
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
  const report = { numCuts: cuts.length, seconds, refused };
  return { cuts: joined(cuts), rows: joined(rows), report };
}
