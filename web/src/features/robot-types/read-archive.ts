/** Reads files from a folder, an archive or a drop. Only this module uses the archive library. */

/** Maximum unpacked size [bytes]; larger archives are not unpacked. */
const MOST_BYTES = 50_000_000;

export class ArchiveError extends Error {
  override name = "ArchiveError";
}

/** All files by path, with archives unpacked. Throws `ArchiveError` with the archive's name. */
export async function readFiles(chosen: readonly (readonly [string, File])[]): Promise<Map<string, Uint8Array>> {
  const found = new Map<string, Uint8Array>();
  for (const [path, file] of chosen) {
    const content = new Uint8Array(await file.arrayBuffer());
    if (!path.toLowerCase().endsWith(".zip")) {
      found.set(path, content);
      continue;
    }
    for (const [name, part] of await unpack(content, path)) found.set(name, part);
  }
  return found;
}

/** The files of an `<input>`, with their paths. */
export function filesFromPicker(list: FileList | null): [string, File][] {
  return [...(list ?? [])].map((file) => [file.webkitRelativePath === "" ? file.name : file.webkitRelativePath, file]);
}

/** The dropped files and folders. */
export async function filesFromDrop(data: DataTransfer): Promise<[string, File][]> {
  const entries = [...data.items].map((item) => item.webkitGetAsEntry()).filter((entry) => entry !== null);
  if (entries.length === 0) return filesFromPicker(data.files);
  return (await Promise.all(entries.map((entry) => inside(entry)))).flat();
}

async function inside(entry: FileSystemEntry): Promise<[string, File][]> {
  const path = entry.fullPath.replace(/^\//, "");
  if (entry.isFile) {
    const file = await new Promise<File>((resolve, reject) => (entry as FileSystemFileEntry).file(resolve, reject));
    return [[path, file]];
  }
  const reader = (entry as FileSystemDirectoryEntry).createReader();
  const found: [string, File][] = [];
  for (;;) {
    // The reader returns batches, and an empty one at the end.
    const some = await new Promise<FileSystemEntry[]>((resolve, reject) => reader.readEntries(resolve, reject));
    if (some.length === 0) return found;
    found.push(...(await Promise.all(some.map((each) => inside(each)))).flat());
  }
}

async function unpack(content: Uint8Array, name: string): Promise<[string, Uint8Array][]> {
  const { unzipSync } = await import("fflate");
  let bytes = 0;
  try {
    const found = unzipSync(content, {
      filter: ({ originalSize }) => {
        bytes += originalSize;
        return bytes <= MOST_BYTES;
      },
    });
    if (bytes > MOST_BYTES) throw new ArchiveError(name);
    return Object.entries(found);
  } catch {
    throw new ArchiveError(name);
  }
}
