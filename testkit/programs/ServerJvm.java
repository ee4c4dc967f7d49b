// SPDX-License-Identifier: Apache-2.0

import java.io.BufferedReader;
import java.io.IOException;
import java.io.InputStreamReader;
import java.io.OutputStream;
import java.net.ServerSocket;
import java.net.Socket;
import java.nio.charset.StandardCharsets;
import java.security.MessageDigest;
import java.util.ArrayDeque;
import java.util.Arrays;
import java.util.HashMap;
import java.util.List;
import java.util.Map;
import java.util.Queue;
import java.util.concurrent.ArrayBlockingQueue;
import java.util.concurrent.BlockingQueue;
import java.util.concurrent.CompletableFuture;
import java.util.concurrent.ConcurrentHashMap;
import java.util.concurrent.ConcurrentLinkedQueue;
import java.util.concurrent.CyclicBarrier;
import java.util.concurrent.Executors;
import java.util.concurrent.ScheduledExecutorService;
import java.util.concurrent.SynchronousQueue;
import java.util.concurrent.ThreadLocalRandom;
import java.util.concurrent.TimeUnit;
import java.util.concurrent.atomic.AtomicInteger;
import java.util.concurrent.atomic.AtomicLong;
import java.util.concurrent.locks.Condition;
import java.util.concurrent.locks.ReentrantLock;
import java.util.stream.IntStream;
import java.util.zip.CRC32;

/** A JVM server: locks, queues, pools, timers, the garbage collector; README.md says what it is asked. */
public class ServerJvm {
	static final int MONEY = 1000;
	static final int ACCOUNTS = 32;
	static final long PATIENCE_MS = 20_000;

	static final Map<String, AtomicLong> beats = new ConcurrentHashMap<>();
	static final Map<String, Integer> counters = new ConcurrentHashMap<>();
	static final Queue<String> wrong = new ConcurrentLinkedQueue<>();
	static final AtomicInteger connections = new AtomicInteger();
	static final int[] accounts = new int[ACCOUNTS];
	static int onTheWay;

	interface Work {
		void once() throws Exception;
	}

	/** A thread that does its work for ever and counts. */
	static void forEver(String name, Work work) {
		AtomicLong beat = beats.computeIfAbsent(name, n -> new AtomicLong());
		new Thread(() -> {
			try {
				for (;;) {
					work.once();
					beat.incrementAndGet();
				}
			} catch (Throwable e) {
				wrong.add(name + ": " + e);
			}
		}, name).start();
	}

	static String data(int n, int seed) {
		StringBuilder out = new StringBuilder(n);
		for (int i = 0; i < n; i++) {
			seed = (seed * 1103515245 + 12345) & 0x7fffffff;
			out.append("abcdefghijklmnop".charAt(seed >> 16 & 15));
		}
		return out.toString();
	}

	static void startBank() {
		Arrays.fill(accounts, MONEY);
		for (int i = 0; i < 4; i++)
			forEver("bank " + i, () -> {
				ThreadLocalRandom random = ThreadLocalRandom.current();
				synchronized (accounts) {
					int amount = random.nextInt(19) - 9;
					accounts[random.nextInt(ACCOUNTS)] -= amount;
					onTheWay += amount;
					if (random.nextInt(10) == 0)
						accounts.wait(1); // lets go of the monitor
					accounts[random.nextInt(ACCOUNTS)] += amount;
					onTheWay -= amount;
				}
				Thread.sleep(random.nextInt(5));
			});
	}

	/** Numbers through queues: none lost, none twice, in order. */
	static void startPipeline() {
		BlockingQueue<Integer> first = new ArrayBlockingQueue<>(8);
		SynchronousQueue<Integer> second = new SynchronousQueue<>();
		int[] next = new int[2];
		forEver("produce", () -> {
			first.put(next[0]++);
			if (next[0] % 16 == 0)
				Thread.sleep(1);
		});
		forEver("pass on", () -> {
			Integer n = first.poll(50, TimeUnit.MILLISECONDS);
			if (n != null)
				second.put(n);
		});
		forEver("consume", () -> {
			int n = second.take();
			if (n != next[1]++)
				throw new IllegalStateException(n + " instead of " + (next[1] - 1));
		});
	}

	static void startTurns() {
		ReentrantLock lock = new ReentrantLock();
		Condition turned = lock.newCondition();
		int[] turn = new int[1];
		CyclicBarrier barrier = new CyclicBarrier(3);
		for (int i = 0; i < 3; i++) {
			int me = i;
			forEver("condition " + me, () -> {
				lock.lock();
				try {
					while (turn[0] % 3 != me)
						turned.await(30, TimeUnit.MILLISECONDS);
					turn[0]++;
					turned.signalAll();
				} finally {
					lock.unlock();
				}
				Thread.sleep(1);
			});
			forEver("barrier " + me, () -> {
				barrier.await();
				Thread.sleep(2);
			});
		}
	}

	static void startPools() throws Exception {
		ScheduledExecutorService timers = Executors.newScheduledThreadPool(2);
		AtomicLong timer = beats.computeIfAbsent("timer", n -> new AtomicLong());
		timers.scheduleAtFixedRate(timer::incrementAndGet, 5, 5, TimeUnit.MILLISECONDS);
		byte[] block = data(50000, 7).getBytes(StandardCharsets.US_ASCII);
		byte[] right = MessageDigest.getInstance("SHA-256").digest(block);
		forEver("futures", () -> {
			int sum = CompletableFuture.supplyAsync(() -> IntStream.range(0, 10000).parallel().sum())
					.thenCombine(CompletableFuture.supplyAsync(() -> 1), Integer::sum).get(60, TimeUnit.SECONDS);
			if (sum != 49995001)
				throw new IllegalStateException("a sum is " + sum);
			Thread.sleep(2);
		});
		forEver("hash", () -> {
			if (!Arrays.equals(MessageDigest.getInstance("SHA-256").digest(block), right))
				throw new IllegalStateException("a hash is another one");
			Thread.sleep(3);
		});
		ArrayDeque<Map<Integer, String>> kept = new ArrayDeque<>();
		forEver("garbage", () -> {
			Map<Integer, String> map = new HashMap<>();
			for (int i = 0; i < 2000; i++)
				map.put(i, Integer.toString(i));
			kept.add(map);
			if (kept.size() > 50)
				kept.remove().forEach((i, text) -> {
					if (!text.equals(Integer.toString(i)))
						throw new IllegalStateException("a map has changed");
				});
			Thread.sleep(5);
		});
	}

	static String check() throws InterruptedException {
		Map<String, Long> before = new HashMap<>();
		beats.forEach((name, n) -> before.put(name, n.get()));
		long deadline = System.nanoTime() + PATIENCE_MS * 1_000_000;
		for (;;) {
			if (!wrong.isEmpty())
				return "bad " + wrong.peek();
			List<String> still = before.keySet().stream().filter(name -> beats.get(name).get() < before.get(name) + 2)
					.toList();
			if (still.isEmpty())
				break;
			if (System.nanoTime() > deadline)
				return "bad these stand still: " + still;
			Thread.sleep(5);
		}
		int money;
		synchronized (accounts) {
			money = Arrays.stream(accounts).sum() + onTheWay;
		}
		if (money != MONEY * ACCOUNTS)
			return "bad the accounts hold " + money;
		return "ok connections=" + connections + " threads=" + Thread.activeCount();
	}

	static String answer(String[] words) throws InterruptedException {
		if (words[1].equals("inc"))
			return counters.merge(words[2], 1, Integer::sum).toString();
		if (words[1].equals("data")) {
			String text = data(Integer.parseInt(words[2]), Integer.parseInt(words[3]));
			CRC32 crc = new CRC32();
			crc.update(text.getBytes(StandardCharsets.US_ASCII));
			return String.format("%08x %s", crc.getValue(), text);
		}
		return check();
	}

	static void serve(Socket socket) {
		connections.incrementAndGet();
		try (socket) {
			socket.setTcpNoDelay(true);
			BufferedReader in = new BufferedReader(
					new InputStreamReader(socket.getInputStream(), StandardCharsets.US_ASCII));
			OutputStream out = socket.getOutputStream();
			for (String line; (line = in.readLine()) != null;) {
				String[] words = line.split(" ");
				out.write((words[0] + " " + answer(words) + "\n").getBytes(StandardCharsets.US_ASCII));
			}
		} catch (IOException e) {
			// The client has gone.
		} catch (Throwable e) {
			wrong.add("a session: " + e);
		} finally {
			connections.decrementAndGet();
		}
	}

	public static void main(String[] args) throws Exception {
		startBank();
		startPipeline();
		startTurns();
		startPools();
		ServerSocket listener = new ServerSocket(7000, 64);
		for (;;) {
			Socket socket = listener.accept();
			new Thread(() -> serve(socket), "session").start();
		}
	}
}
