/** Selects the files of a robot type from the chosen folder and packs them for the upload. */
import type { TypeFolder } from "../../../shared/api/robot-types";

export const MANIFEST = "robot.toml";
const SCRIPT = /^movements\/([^/]+)\.py$/;
const MODEL = /\.(xml|stl|obj|png)$/;
/** The server's limit for all files [bytes]. */
export const MAX_BYTES = 6_000_000;
const CHUNK = 0x8000;

export type Files = ReadonlyMap<string, Uint8Array>;

interface SelectedUpload {
  files: Map<string, Uint8Array>;
  ignored: string[];
}

/** The files in the folder of `robot.toml`, by relative path. Without a manifest: below the common parent folder. */
export function selectFiles(entries: Files): SelectedUpload {
  const files = new Map<string, Uint8Array>();
  const ignored: string[] = [];
  const names = [...entries.keys()].filter((name) => !name.endsWith("/") && !hidden(name));
  const root = rootOf(names);
  for (const name of names) {
    const relative = name.slice(root.length);
    const content = entries.get(name);
    if (content === undefined) continue;
    if (name.startsWith(root) && belongs(relative)) files.set(relative, content);
    else ignored.push(name);
  }
  return { files, ignored };
}

/** The folder's content in the server's format; `null` without a manifest. */
export function packFiles(files: Files): TypeFolder | null {
  const text = new TextDecoder();
  const manifest = files.get(MANIFEST);
  if (manifest === undefined) return null;
  const folder: TypeFolder = { manifest: text.decode(manifest), files: {}, movements: {} };
  for (const [name, content] of files) {
    const script = SCRIPT.exec(name)?.[1];
    if (script !== undefined) folder.movements[script] = text.decode(content);
    else if (name.endsWith(".xml")) folder.files[name] = text.decode(content);
    else if (name !== MANIFEST) folder.files[name] = base64(content);
  }
  return folder;
}

export function size(files: Files): number {
  return [...files.values()].reduce((sum, content) => sum + content.length, 0);
}

function belongs(name: string): boolean {
  return name === MANIFEST || SCRIPT.test(name) || MODEL.test(name);
}

/** Files that file systems and archivers add. */
function hidden(name: string): boolean {
  return name.split("/").some((part) => part.startsWith(".") || part === "__MACOSX" || part === "__pycache__");
}

function rootOf(names: readonly string[]): string {
  const manifests = names.filter((name) => name === MANIFEST || name.endsWith(`/${MANIFEST}`));
  const nearest = manifests.sort((one, other) => one.length - other.length)[0];
  if (nearest !== undefined) return nearest.slice(0, -MANIFEST.length);
  const first = names[0] ?? "";
  const folder = first.slice(0, first.indexOf("/") + 1);
  return folder !== "" && folder !== "movements/" && names.every((name) => name.startsWith(folder)) ? folder : "";
}

function base64(content: Uint8Array): string {
  let text = "";
  for (let start = 0; start < content.length; start += CHUNK) {
    text += String.fromCharCode(...content.subarray(start, start + CHUNK));
  }
  return btoa(text);
}
