// Removes URLs from package-lock.json, so that every registry can serve the packages. Tests check the lock files.
// `npm run lock` runs it in the folder of the lock file after a change of dependencies.
import { readFileSync, writeFileSync } from "node:fs";

const path = "package-lock.json";
const lock = JSON.parse(readFileSync(path, "utf8"));
for (const entry of Object.values(lock.packages)) {
  delete entry.funding;
  delete entry.deprecated;
  delete entry.resolved;
  if (entry.license?.includes("://")) delete entry.license;
}
writeFileSync(path, `${JSON.stringify(lock, null, 2)}\n`);
