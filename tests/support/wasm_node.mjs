// Runs trials of test_wasm.py in Node.js:
//   node wasm_node.mjs CORE.js TRIALS.js CORE.wasm FOLDER
// FOLDER has arrays.bin and trials.json. The results go to cuts.bin and rows.bin there.

import { readFileSync, writeFileSync } from "node:fs";
import { join } from "node:path";
import { pathToFileURL } from "node:url";

const [coreFile, trialsFile, codeFile, folder] = process.argv.slice(2);
const module = await import(pathToFileURL(coreFile).href);
const { runTrials } = await import(pathToFileURL(trialsFile).href);
const trials = JSON.parse(readFileSync(join(folder, "trials.json"), "utf8"));
const { buffer } = new Uint8Array(readFileSync(join(folder, "arrays.bin")));
const { cuts, rows, report } = await runTrials(module, readFileSync(codeFile), trials, buffer);
writeFileSync(join(folder, "cuts.bin"), cuts);
writeFileSync(join(folder, "rows.bin"), rows);
console.log(JSON.stringify(report));
