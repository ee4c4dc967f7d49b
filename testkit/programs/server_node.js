// SPDX-License-Identifier: Apache-2.0
// A Node.js server with timers, promises, libuv's thread pool and worker threads; README.md says what it is asked.
'use strict';

const crypto = require('crypto');
const fs = require('fs');
const net = require('net');
const zlib = require('zlib');
const { Worker, isMainThread, parentPort, workerData } = require('worker_threads');

const MONEY = 1000;
const PATIENCE_MS = 20000;

if (!isMainThread) {
  // Shares memory with the main thread, and waits for it by futex.
  const board = new Int32Array(workerData.board);
  const me = workerData.me;
  let wanted = 0;
  parentPort.on('message', (n) => {
    if (n !== wanted) throw new Error(`worker ${me}: message ${n} instead of ${wanted}`);
    wanted = n + 1;
    let sum = 0;
    for (let i = 0; i < 20000; i++) sum = (sum + i * n) % 1000003;
    Atomics.wait(board, 0, 12345, 1); // returns at once: it never holds 12345
    Atomics.wait(board, 1, 0, 1); // a time limit of 1 ms
    Atomics.add(board, 2 + me, 1);
    parentPort.postMessage([n, sum]);
  });
} else {
  main();
}

function crcTable() {
  const table = new Uint32Array(256);
  for (let n = 0; n < 256; n++) {
    let c = n;
    for (let k = 0; k < 8; k++) c = c & 1 ? 0xedb88320 ^ (c >>> 1) : c >>> 1;
    table[n] = c;
  }
  return table;
}

function main() {
  const table = crcTable();
  const beats = new Map();
  const wrong = [];
  const counters = new Map();
  let connections = 0;
  const beat = (name) => beats.set(name, (beats.get(name) || 0) + 1);
  const sleep = (ms) => new Promise((resolve) => setTimeout(resolve, ms));

  function crc32(text) {
    let c = 0xffffffff;
    for (let i = 0; i < text.length; i++) c = table[(c ^ text.charCodeAt(i)) & 0xff] ^ (c >>> 8);
    return ((c ^ 0xffffffff) >>> 0).toString(16).padStart(8, '0');
  }

  function data(n, seed) {
    const letters = 'abcdefghijklmnop';
    const out = [];
    for (let i = 0; i < n; i++) {
      seed = (Math.imul(seed, 1103515245) + 12345) & 0x7fffffff;
      out.push(letters[(seed >> 16) & 15]);
    }
    return out.join('');
  }

  // Money on its way between accounts, over awaits.
  const accounts = new Array(32).fill(MONEY);
  const onTheWay = new Map();
  const any = () => Math.floor(Math.random() * accounts.length);
  async function transfer(me) {
    for (;;) {
      const amount = 1 + Math.floor(Math.random() * 9);
      accounts[any()] -= amount;
      onTheWay.set(me, amount);
      await sleep(Math.random() * 10);
      accounts[any()] += amount;
      onTheWay.delete(me);
      beat(`transfer ${me}`);
    }
  }

  // libuv's thread pool: cryptography, compression, files.
  const block = Buffer.from(data(20000, 7));
  const right = crypto.pbkdf2Sync('secret', 'salt', 20, 32, 'sha256').toString('hex');
  async function derive() {
    for (;;) {
      const key = await new Promise((resolve, reject) =>
        crypto.pbkdf2('secret', 'salt', 20, 32, 'sha256', (e, k) => (e ? reject(e) : resolve(k))));
      if (key.toString('hex') !== right) wrong.push('pbkdf2 gave another key');
      beat('pbkdf2');
      await sleep(3);
    }
  }
  async function compress() {
    for (;;) {
      const small = await new Promise((resolve, reject) =>
        zlib.deflate(block, (e, out) => (e ? reject(e) : resolve(out))));
      const back = await new Promise((resolve, reject) =>
        zlib.inflate(small, (e, out) => (e ? reject(e) : resolve(out))));
      if (!back.equals(block)) wrong.push('zlib gave other data');
      beat('zlib');
      await sleep(10);
    }
  }
  const script = fs.readFileSync(__filename, 'utf8');
  async function readFile() {
    for (;;) {
      if ((await fs.promises.readFile(__filename, 'utf8')) !== script) wrong.push('a file reads differently');
      beat('file');
      await sleep(10);
    }
  }

  // Worker threads.
  const board = new SharedArrayBuffer(64);
  for (let me = 0; me < 2; me++) {
    const worker = new Worker(__filename, { workerData: { board, me } });
    let n = 0;
    worker.on('message', ([got, sum]) => {
      let check = 0;
      for (let i = 0; i < 20000; i++) check = (check + i * n) % 1000003;
      if (got !== n || sum !== check) wrong.push(`worker ${me} answered ${got} ${sum} instead of ${n} ${check}`);
      n++;
      beat(`worker ${me}`);
      setTimeout(() => worker.postMessage(n), 2);
    });
    worker.on('error', (e) => wrong.push(`worker ${me}: ${e.message}`));
    worker.on('exit', (status) => wrong.push(`worker ${me} ended with ${status}`));
    worker.postMessage(n);
  }

  setInterval(() => beat('interval'), 5);
  (function immediate() {
    beat('immediate');
    setTimeout(() => setImmediate(immediate), 5);
  })();
  for (let me = 0; me < 8; me++) transfer(me);
  derive();
  compress();
  readFile();
  // Something for the garbage collector.
  const rubbish = [];
  setInterval(() => {
    rubbish.push(Array.from({ length: 2000 }, (_, i) => ({ i, text: `${i}` })));
    if (rubbish.length > 20) {
      const old = rubbish.shift();
      if (!old.every((o, i) => o.i === i && o.text === `${i}`)) wrong.push('an object has changed');
    }
    beat('rubbish');
  }, 20);

  async function check() {
    const before = new Map(beats);
    const deadline = Date.now() + PATIENCE_MS;
    for (;;) {
      const still = [...before].filter(([name, n]) => beats.get(name) < n + 2).map(([name]) => name);
      if (!still.length) break;
      if (Date.now() > deadline) return `bad these stand still: ${still.join(', ')}`;
      await sleep(5);
    }
    const money = [...accounts, ...onTheWay.values()].reduce((a, b) => a + b, 0);
    if (money !== MONEY * accounts.length) return `bad the accounts hold ${money}`;
    return wrong.length ? `bad ${wrong[0]}` : `ok connections=${connections} kinds=${before.size}`;
  }

  net.createServer((socket) => {
    connections++;
    socket.setNoDelay(true);
    socket.setEncoding('latin1');
    let rest = '';
    socket.on('data', async (chunk) => {
      const lines = (rest + chunk).split('\n');
      rest = lines.pop();
      for (const line of lines) {
        const [id, what, ...args] = line.split(' ');
        let answer;
        if (what === 'inc') {
          counters.set(args[0], (counters.get(args[0]) || 0) + 1);
          answer = counters.get(args[0]);
        } else if (what === 'data') {
          const text = data(Number(args[0]), Number(args[1]));
          answer = `${crc32(text)} ${text}`;
        } else {
          answer = await check();
        }
        socket.write(`${id} ${answer}\n`);
      }
    });
    socket.on('error', () => {});
    socket.on('close', () => connections--);
  }).listen(7000, '0.0.0.0');
}
