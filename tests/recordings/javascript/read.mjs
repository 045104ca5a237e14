// Prints a line of JSON for each message of an MCAP file: topic, log time, and the content of its fields.
// A field is a number, a text, or of an array of numbers [length, sum of the finite ones, first, last].
import { readFileSync } from "node:fs";
import { McapIndexedReader } from "@mcap/core";
import { loadDecompressHandlers } from "@mcap/support";
import { parse } from "@foxglove/rosmsg";
import { MessageReader } from "@foxglove/rosmsg2-serialization";
import protobuf from "protobufjs";
import descriptor from "protobufjs/ext/descriptor/index.js";

const file = readFileSync(process.argv[2]);
const readable = {
  size: async () => BigInt(file.length),
  read: async (offset, length) => new Uint8Array(file.subarray(Number(offset), Number(offset + length))),
};

function decoderOf(channel, schema) {
  if (channel.messageEncoding === "cdr") {
    const reader = new MessageReader(parse(new TextDecoder().decode(schema.data), { ros2: true }));
    return (data) => reader.readMessage(data);
  }
  const type = protobuf.Root.fromDescriptor(descriptor.FileDescriptorSet.decode(schema.data)).lookupType(schema.name);
  return (data) => type.decode(data);
}

const isNumber = (value) => typeof value === "number" || typeof value === "bigint" || typeof value === "boolean";
const plain = (value) => (Number.isFinite(Number(value)) ? Number(value) : null);

function fields(value, path, found) {
  if (isNumber(value)) found[path] = plain(value);
  else if (typeof value === "string") found[path] = value;
  else if (protobuf.util.Long?.isLong?.(value)) found[path] = Number(value);
  else if (ArrayBuffer.isView(value) || (Array.isArray(value) && (value.length === 0 || isNumber(value[0])))) {
    let sum = 0;
    for (const one of value) if (Number.isFinite(Number(one))) sum += Number(one);
    found[path] = [value.length, sum, plain(value[0] ?? 0), plain(value[value.length - 1] ?? 0)];
  } else if (Array.isArray(value)) value.forEach((one, place) => fields(one, `${path}/${place}`, found));
  else for (const name of Object.keys(value)) fields(value[name], `${path}/${name}`, found);
  return found;
}

const reader = await McapIndexedReader.Initialize({ readable, decompressHandlers: await loadDecompressHandlers() });
const decoders = new Map();
for await (const message of reader.readMessages()) {
  if (!decoders.has(message.channelId)) {
    const channel = reader.channelsById.get(message.channelId);
    decoders.set(message.channelId, [channel.topic, decoderOf(channel, reader.schemasById.get(channel.schemaId))]);
  }
  const [topic, decode] = decoders.get(message.channelId);
  console.log(JSON.stringify([topic, String(message.logTime), fields(decode(message.data), "", {})]));
}
