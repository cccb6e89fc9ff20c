/** Reads files from a folder, an archive or a drop. Only this module uses the archive library. */

/** Maximum unpacked size [bytes]; larger archives are not unpacked. */
const MAX_UNPACKED_BYTES = 50_000_000;

export class ArchiveError extends Error {
  override name = "ArchiveError";
}

/** All files by path, with archives unpacked. Throws `ArchiveError` with the archive's name. */
export async function readFiles(chosen: readonly (readonly [string, File])[]): Promise<Map<string, Uint8Array>> {
  const files = new Map<string, Uint8Array>();
  for (const [path, file] of chosen) {
    const content = new Uint8Array(await file.arrayBuffer());
    if (!path.toLowerCase().endsWith(".zip")) {
      files.set(path, content);
      continue;
    }
    for (const [name, part] of await unpack(content, path)) files.set(name, part);
  }
  return files;
}

/** The files of an `<input>`, with their paths. */
export function filesFromPicker(list: FileList | null): [string, File][] {
  return [...(list ?? [])].map((file) => [file.webkitRelativePath === "" ? file.name : file.webkitRelativePath, file]);
}

/** The dropped files and folders. */
export async function filesFromDrop(data: DataTransfer): Promise<[string, File][]> {
  const entries = [...data.items].map((item) => item.webkitGetAsEntry()).filter((entry) => entry !== null);
  if (entries.length === 0) return filesFromPicker(data.files);
  return (await Promise.all(entries.map((entry) => filesOf(entry)))).flat();
}

async function filesOf(entry: FileSystemEntry): Promise<[string, File][]> {
  const path = entry.fullPath.replace(/^\//, "");
  if (entry.isFile) {
    const file = await new Promise<File>((resolve, reject) => (entry as FileSystemFileEntry).file(resolve, reject));
    return [[path, file]];
  }
  const reader = (entry as FileSystemDirectoryEntry).createReader();
  const files: [string, File][] = [];
  for (;;) {
    // The reader returns batches, and an empty one at the end.
    const batch = await new Promise<FileSystemEntry[]>((resolve, reject) => reader.readEntries(resolve, reject));
    if (batch.length === 0) return files;
    files.push(...(await Promise.all(batch.map((each) => filesOf(each)))).flat());
  }
}

async function unpack(content: Uint8Array, name: string): Promise<[string, Uint8Array][]> {
  const { unzipSync } = await import("fflate");
  let bytes = 0;
  try {
    const found = unzipSync(content, {
      filter: ({ originalSize }) => {
        bytes += originalSize;
        return bytes <= MAX_UNPACKED_BYTES;
      },
    });
    if (bytes > MAX_UNPACKED_BYTES) throw new ArchiveError(name);
    return Object.entries(found);
  } catch {
    throw new ArchiveError(name);
  }
}
