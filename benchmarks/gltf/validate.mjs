// node validate.mjs FILE.glb prints what Khronos' glTF validator says of a file, as JSON.
import { readFile } from "node:fs/promises";
import validator from "gltf-validator";

const bytes = new Uint8Array(await readFile(process.argv[2]));
const report = await validator.validateBytes(bytes, { maxIssues: 100 });
console.log(JSON.stringify({ version: validator.version(), ...report.issues }));
