// Takes addresses out of package-lock.json: npm writes who asks for donations, which no installation reads.
// Run by `npm run lock` after a change of dependencies, in the folder of the lock file; tests hold lock files to it.
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
