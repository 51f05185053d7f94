// Policies from ONNX files: a reader of the parts of protobuf that plain networks need, and their operations. Nothing in a file
// is executed, and what is not known is refused by name.

const LARGEST_FILE = 2 ** 24; // bytes
const MOST_NODES = 500;
const BROKEN = "it is cut off, or it is no ONNX file";

/** Reads a whole number at `cursor.at`, and moves it on. Negative ones, which nothing here needs, come out as huge ones. */
function varint(bytes, cursor) {
  let value = 0;
  for (let place = 1; place < 2 ** 70 && cursor.at < bytes.length; place *= 128) {
    const byte = bytes[cursor.at++];
    value += (byte & 127) * place;
    if (byte < 128) return value;
  }
  throw new Error(BROKEN);
}

/** The fields of a message by number, each a list of whole numbers or of bytes. */
function fieldsOf(bytes) {
  const fields = new Map();
  for (const cursor = { at: 0 }; cursor.at < bytes.length; ) {
    const key = varint(bytes, cursor);
    const [number, kind] = [Math.floor(key / 8), key % 8];
    let value = kind === 0 || kind === 2 ? varint(bytes, cursor) : { 1: 8, 5: 4 }[kind];
    if (kind !== 0) {
      const end = cursor.at + value;
      if (!(end <= bytes.length)) throw new Error(BROKEN);
      value = bytes.subarray(cursor.at, end);
      cursor.at = end;
    }
    if (!fields.has(number)) fields.set(number, []);
    fields.get(number).push(value);
  }
  return fields;
}

const listed = (fields, number) => fields.get(number) ?? [];
const messages = (fields, number) => listed(fields, number).map((bytes) => fieldsOf(checkedBytes(bytes)));
const texts = (fields, number) => listed(fields, number).map((bytes) => new TextDecoder().decode(checkedBytes(bytes)));

function checkedBytes(value) {
  if (!(value instanceof Uint8Array)) throw new Error(BROKEN);
  return value;
}

/** Whole numbers, which may be packed into bytes. */
function wholes(fields, number) {
  return listed(fields, number).flatMap((value) => {
    const found = [];
    if (typeof value === "number") found.push(value);
    else for (const cursor = { at: 0 }; cursor.at < value.length; ) found.push(varint(value, cursor));
    return found;
  });
}

function floats(chunks, double) {
  const bytes = chunks.length === 1 ? checkedBytes(chunks[0]).slice() : Uint8Array.from(chunks.map(checkedBytes).flatMap((chunk) => [...chunk]));
  if (bytes.length % (double ? 8 : 4)) throw new Error(BROKEN);
  const { buffer } = bytes;
  return double ? new Float64Array(buffer) : new Float32Array(buffer);
}

/** A TensorProto as its shape and its numbers. */
function tensorOf(fields) {
  const [type] = wholes(fields, 2);
  const name = texts(fields, 8)[0] ?? "";
  if (type !== 1 && type !== 11) throw new Error(`the numbers of ${name} are not floating-point ones of 32 or 64 bits`);
  if (fields.has(13) || wholes(fields, 14)[0]) throw new Error("its weights are in another file; save it as one file");
  const data = floats(listed(fields, fields.has(9) ? 9 : type === 1 ? 4 : 10), type === 11);
  const shape = wholes(fields, 1);
  if (shape.reduce((product, size) => product * size, 1) !== data.length) throw new Error(`${name} has not as many numbers as its shape says`);
  return { name, shape, data };
}

/** A function of each number of rows, or of a row and single numbers. */
function each(compute) {
  return (values, attributes) => {
    const size = Math.max(...values.map(({ data }) => data.length));
    const fits = values.every(({ data, shape }) => data.length === 1 || (data.length === size && shape.at(-1) === size));
    if (!fits) throw new Error("the sizes of its layers do not fit together");
    const at = ({ data }, i) => data[data.length === 1 ? 0 : i];
    const data = Array.from({ length: size }, (_, i) => compute(...values.map((value) => at(value, i)), attributes));
    return { shape: [1, size], data };
  };
}

/** A row times a matrix. */
function product(row, matrix, transposed) {
  const [rows, columns] = matrix.shape;
  const [inner, outer] = transposed ? [columns, rows] : [rows, columns];
  if (matrix.shape.length !== 2 || row.data.length !== inner || row.shape.at(-1) !== inner) throw new Error("the sizes of its layers do not fit together");
  const data = new Array(outer).fill(0);
  for (let i = 0; i < inner; i++) {
    for (let j = 0; j < outer; j++) data[j] += row.data[i] * matrix.data[transposed ? j * inner + i : i * outer + j];
  }
  return { shape: [1, outer], data };
}

const OPERATIONS = {
  Gemm([row, matrix, bias], { transA = 0, transB = 0, alpha = 1, beta = 1 }) {
    if (transA) throw new Error("Gemm with transA is not supported");
    const scaled = each((a) => alpha * a)([product(row, matrix, transB)]);
    return bias ? each((a, b) => a + beta * b)([scaled, bias]) : scaled;
  },
  MatMul: ([row, matrix]) => product(row, matrix, 0),
  Add: each((a, b) => a + b),
  Sub: each((a, b) => a - b),
  Mul: each((a, b) => a * b),
  Div: each((a, b) => a / b),
  Tanh: each(Math.tanh),
  Relu: each((a) => Math.max(a, 0)),
  Sigmoid: each((a) => 1 / (1 + Math.exp(-a))),
  Elu: each((a, { alpha = 1 }) => (a > 0 ? a : alpha * Math.expm1(a))),
  Clip: ([row, low, high]) => each((a) => Math.min(Math.max(a, low?.data[0] ?? -Infinity), high?.data[0] ?? Infinity))([row]),
  Identity: ([row]) => row,
  Flatten: ([row]) => row,
  Constant: (_, { value }) => value,
};

/** A NodeProto as what it takes and gives, and its operation. */
function nodeOf(fields) {
  const attributes = Object.create(null);
  for (const attribute of messages(fields, 5)) {
    const [name] = texts(attribute, 1);
    if (attribute.has(2)) [attributes[name]] = floats(listed(attribute, 2), false);
    if (attribute.has(3)) [attributes[name]] = wholes(attribute, 3);
    if (attribute.has(5)) attributes[name] = tensorOf(messages(attribute, 5)[0]);
  }
  return { takes: texts(fields, 1), gives: texts(fields, 2), kind: texts(fields, 4)[0] ?? "", attributes };
}

/** A network in an ONNX file, as a controller. Throws an Error that says what is not supported. */
class OnnxPolicy {
  /** `bytes` of the file; `model` of the task, or null until it is known. */
  constructor(bytes, model = null) {
    if (bytes.length > LARGEST_FILE) throw new Error(`it is larger than ${LARGEST_FILE / 2 ** 20} MiB`);
    this.model = model;
    const file = fieldsOf(bytes);
    const [graph] = messages(file, 7);
    if (!graph) throw new Error(BROKEN);
    this.task = messages(file, 14).find((entry) => texts(entry, 1)[0] === "task");
    this.task = this.task ? texts(this.task, 2)[0] : null; // the id of the task that it is made for, if it says so
    this.nodes = messages(graph, 1).map(nodeOf);
    if (this.nodes.length > MOST_NODES) throw new Error(`it has more than ${MOST_NODES} operations`);
    const unknown = this.nodes.map(({ kind }) => kind).filter((kind) => !Object.hasOwn(OPERATIONS, kind));
    if (unknown.length) {
      const names = [...new Set(unknown)].slice(0, 8).join(", ");
      throw new Error(`it needs ${names}, and this page computes ${Object.keys(OPERATIONS).join(", ")} alone; "ballbot page POLICY.json" shows any policy of ours`);
    }
    this.weights = new Map(messages(graph, 5).map(tensorOf).map((tensor) => [tensor.name, tensor]));
    const inputs = messages(graph, 11).filter((input) => !this.weights.has(texts(input, 1)[0]));
    if (inputs.length !== 1) throw new Error(`it has ${inputs.length} inputs, and a policy has one, the observation`);
    this.input = texts(inputs[0], 1)[0];
    this.output = texts(messages(graph, 12)[0] ?? new Map(), 1)[0];
    const [type] = messages(inputs[0], 2).flatMap((kind) => messages(kind, 1));
    const dimensions = type ? messages(type, 2).flatMap((shape) => messages(shape, 1)) : [];
    [this.observations] = dimensions.length ? wholes(dimensions.at(-1), 1) : [];
    if (!(this.observations > 0 && this.observations <= 1000)) throw new Error("it does not say how many numbers it observes");
    const action = this.run(new Array(this.observations).fill(0));
    if (action.length !== 2 || !action.every(Number.isFinite)) throw new Error(`its action is ${action.slice(0, 4).join(", ")}, and not two finite numbers`);
  }

  run(observation) {
    const values = new Map(this.weights).set(this.input, { shape: [1, observation.length], data: observation });
    for (const { takes, gives, kind, attributes } of this.nodes) {
      const found = takes.map((name) => values.get(name)); // "" stands for an input that is left out
      if (takes.some((name, i) => name && !found[i]) || (kind !== "Constant" && !found[0])) throw new Error(`${kind} takes what nothing before it gives`);
      values.set(gives[0], OPERATIONS[kind](found, attributes));
    }
    if (!values.has(this.output)) throw new Error("nothing gives its output");
    return Array.from(values.get(this.output).data);
  }

  act(k, x, c) {
    const observation = Array.from(Float32Array.from(this.model.observe(x, c)));
    return this.run(observation).map((a) => DATA.force_limit * Math.min(Math.max(a, -1), 1));
  }
}
