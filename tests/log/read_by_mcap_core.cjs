// Prints what @mcap/core reads of MCAP files, by their indexes and from the front: a line of JSON
// for each file, with the SHA-256 of each topic's times (int64) and fields (double), little-endian;
// null where it refuses a file from the front because of what follows the footer.
const { createHash } = require("node:crypto");
const { open } = require("node:fs/promises");
const { createReadStream } = require("node:fs");
const { McapIndexedReader, McapStreamReader } = require("@mcap/core");
const { FileHandleReadable } = require("@mcap/nodejs");
const { loadDecompressHandlers, protobufFromBinaryDescriptor } = require("@mcap/support");

class Topics {
  constructor() {
    this.schemas = new Map();
    this.channels = new Map();
    this.topics = new Map();
  }

  schema(record) {
    const root = protobufFromBinaryDescriptor(record.data);
    const type = root.lookupType(record.name);
    const fields = Object.keys(type.fieldsById).map(Number).sort((a, b) => a - b);
    this.schemas.set(record.id, { type, names: fields.map((id) => type.fieldsById[id].name) });
  }

  channel(record) {
    this.channels.set(record.id, record);
  }

  message(record) {
    const { topic, schemaId } = this.channels.get(record.channelId);
    if (topic.startsWith("/cosim/")) {
      return;
    }
    const { type, names } = this.schemas.get(schemaId);
    const decoded = type.decode(record.data);
    const row = Buffer.alloc(8 * (1 + names.length));
    row.writeBigInt64LE(record.logTime, 0);
    names.forEach((name, index) => {
      const value = decoded[name];
      row.writeDoubleLE(Number.isNaN(value) ? NaN : value, 8 * (1 + index)); // NaN of one kind
    });
    if (!this.topics.has(topic)) {
      this.topics.set(topic, createHash("sha256"));
    }
    this.topics.get(topic).update(row);
  }

  hashes() {
    const pairs = [...this.topics].map(([topic, hash]) => [topic, hash.digest("hex")]);
    return Object.fromEntries(pairs);
  }
}

async function byIndexes(path, decompressHandlers) {
  const handle = await open(path);
  const topics = new Topics();
  const readable = new FileHandleReadable(handle);
  const reader = await McapIndexedReader.Initialize({ readable, decompressHandlers });
  reader.schemasById.forEach((record) => topics.schema(record));
  reader.channelsById.forEach((record) => topics.channel(record));
  for await (const message of reader.readMessages()) {
    topics.message(message);
  }
  await handle.close();
  return topics.hashes();
}

async function fromTheFront(path, decompressHandlers) {
  const topics = new Topics();
  const reader = new McapStreamReader({ decompressHandlers, validateCrcs: true });
  const seen = { Schema: "schema", Channel: "channel", Message: "message" };
  for await (const piece of createReadStream(path)) {
    reader.append(piece);
    for (let record; (record = reader.nextRecord()); ) {
      if (record.type in seen) {
        topics[seen[record.type]](record);
      }
    }
  }
  if (!reader.done()) {
    throw new Error(`${path} has no end`);
  }
  return topics.hashes();
}

async function main() {
  const handlers = await loadDecompressHandlers();
  for (const path of process.argv.slice(2)) {
    const indexed = await byIndexes(path, handlers);
    const streamed = await fromTheFront(path, handlers).catch((error) => {
      if (/bytes remaining after MCAP footer/.test(error.message)) {
        return null;
      }
      throw error;
    });
    console.log(JSON.stringify({ path, indexed, streamed }));
  }
}

main().catch((error) => {
  console.error(error);
  process.exit(1);
});
