/**
 * Of the npm packages, nothing but the files of installed.json is run: their hashes were checked before this process was
 * started (converters/runtimes/installed.py), those of a file that somebody put beside them were not.
 */

import { readFileSync, realpathSync } from "node:fs";
import Module from "node:module";
import path from "node:path";

/** @param {string} modules the folder that holds node_modules */
export function onlyKnown(modules) {
  const known = JSON.parse(readFileSync(new URL("./installed.json", import.meta.url), "utf8"));
  const root = realpathSync(path.join(path.resolve(modules), "node_modules"));
  Module._extensions[".node"] = (module, file) => {
    throw new Error(`${file} is not among the files that were installed`);
  };
  const compile = Module.prototype._compile;
  Module.prototype._compile = function compileKnown(content, file, ...rest) {
    const name = path.relative(root, file).split(path.sep).join("/");
    if (!Object.hasOwn(known, name)) throw new Error(`${file} is not among the files that were installed`);
    return compile.call(this, content, file, ...rest);
  };
}
