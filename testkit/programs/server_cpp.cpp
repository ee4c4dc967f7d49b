// SPDX-License-Identifier: Apache-2.0

// A C++ server: thread pools, futures, condition variables and whatever else C++20 can wait with; README.md says what
// it is asked.

#include <netinet/in.h>
#include <netinet/tcp.h>
#include <sys/socket.h>
#include <unistd.h>

#include <array>
#include <atomic>
#include <barrier>
#include <chrono>
#include <condition_variable>
#include <csignal>
#include <cstdint>
#include <cstdio>
#include <deque>
#include <functional>
#include <future>
#include <latch>
#include <map>
#include <memory>
#include <mutex>
#include <numeric>
#include <random>
#include <semaphore>
#include <shared_mutex>
#include <sstream>
#include <string>
#include <thread>
#include <vector>

using namespace std::chrono_literals;

namespace {

constexpr int MONEY = 1000;
constexpr int ACCOUNTS = 32;
constexpr auto PATIENCE = 20s;

std::mutex books;
std::map<std::string, long> counters;
std::map<std::string, std::atomic<long>> beats; // grows only
std::vector<std::string> wrong;
std::atomic<int> connections;

void complain(const std::string &what)
{
	std::lock_guard hold(books);
	wrong.push_back(what);
}

std::atomic<long> &beat(const std::string &name)
{
	std::lock_guard hold(books);
	return beats[name];
}

/// A thread that does its work for ever and counts.
void for_ever(const std::string &name, std::function<void()> work)
{
	auto &count = beat(name);
	std::thread([&count, work = std::move(work)] {
		for (;; count++)
			work();
	}).detach();
}

int random_below(int n)
{
	thread_local std::minstd_rand engine(std::random_device{}());
	return static_cast<int>(engine() % static_cast<unsigned>(n));
}

std::string data(int n, uint32_t seed)
{
	std::string out;
	for (int i = 0; i < n; i++) {
		seed = (seed * 1103515245 + 12345) & 0x7fffffff;
		out += "abcdefghijklmnop"[seed >> 16 & 15];
	}
	return out;
}

uint32_t crc32(const std::string &text)
{
	static const auto table = [] {
		std::array<uint32_t, 256> made{};
		for (uint32_t n = 0; n < 256; n++) {
			made[n] = n;
			for (int k = 0; k < 8; k++)
				made[n] = made[n] & 1 ? 0xedb88320 ^ made[n] >> 1 : made[n] >> 1;
		}
		return made;
	}();
	uint32_t crc = ~0U;
	for (unsigned char c : text)
		crc = table[(crc ^ c) & 0xff] ^ crc >> 8;
	return ~crc;
}

/// Tasks for threads that wait on a condition variable.
class Pool {
public:
	explicit Pool(int threads)
	{
		for (int i = 0; i < threads; i++)
			std::thread([this] { run(); }).detach();
	}

	template <typename F> auto submit(F task) -> std::future<decltype(task())>
	{
		auto packaged = std::make_shared<std::packaged_task<decltype(task())()>>(std::move(task));
		auto result = packaged->get_future();
		{
			std::lock_guard hold(lock);
			tasks.emplace_back([packaged] { (*packaged)(); });
		}
		there_is_work.notify_one();
		return result;
	}

private:
	void run()
	{
		for (;;) {
			std::unique_lock hold(lock);
			there_is_work.wait(hold, [this] { return !tasks.empty(); });
			auto task = std::move(tasks.front());
			tasks.pop_front();
			hold.unlock();
			task();
		}
	}

	std::mutex lock;
	std::condition_variable there_is_work;
	std::deque<std::function<void()>> tasks;
};

/// A bounded queue; numbers go through it in order, none lost, none twice.
class Queue {
public:
	void put(long n)
	{
		std::unique_lock hold(lock);
		changed.wait(hold, [this] { return items.size() < 8; });
		items.push_back(n);
		changed.notify_all();
	}

	bool take(long &n)
	{
		std::unique_lock hold(lock);
		if (!changed.wait_for(hold, 50ms, [this] { return !items.empty(); }))
			return false;
		n = items.front();
		items.pop_front();
		changed.notify_all();
		return true;
	}

private:
	std::mutex lock;
	std::condition_variable changed;
	std::deque<long> items;
};

std::shared_mutex bank;
std::array<int, ACCOUNTS> accounts;

void start_bank()
{
	accounts.fill(MONEY);
	for (int i = 0; i < 4; i++)
		for_ever("bank " + std::to_string(i), [] {
			{
				std::unique_lock hold(bank);
				int amount = random_below(19) - 9;
				accounts[random_below(ACCOUNTS)] -= amount;
				if (random_below(10) == 0)
					std::this_thread::sleep_for(100us);
				accounts[random_below(ACCOUNTS)] += amount;
			}
			std::this_thread::sleep_for(std::chrono::microseconds(random_below(4000)));
		});
	for_ever("bank reader", [] {
		std::shared_lock hold(bank);
		if (std::accumulate(accounts.begin(), accounts.end(), 0) != MONEY * ACCOUNTS)
			complain("the accounts hold another sum");
		hold.unlock();
		std::this_thread::sleep_for(2ms);
	});
}

void start_queue()
{
	static Queue queue;
	for_ever("produce", [n = 0L]() mutable {
		queue.put(n++);
		if (n % 16 == 0)
			std::this_thread::sleep_for(1ms);
	});
	for_ever("consume", [wanted = 0L]() mutable {
		long n;
		if (!queue.take(n))
			return;
		if (n != wanted)
			complain("queue: " + std::to_string(n) + " instead of " + std::to_string(wanted));
		wanted = n + 1;
	});
}

void start_futures()
{
	static Pool pool(4);
	static const std::string block = data(50000, 7);
	static const uint32_t right = crc32(block);
	for_ever("pool", [] {
		std::vector<std::future<uint32_t>> results;
		for (int i = 0; i < 4; i++)
			results.push_back(pool.submit([] { return crc32(block); }));
		for (auto &each : results)
			if (each.get() != right)
				complain("a checksum is another one");
		std::this_thread::sleep_for(1ms);
	});
	for_ever("async", [] { // a new thread each time
		auto one = std::async(std::launch::async, [] { return 20; });
		auto other = std::async(std::launch::async, [&one] { return one.get() + 22; });
		while (other.wait_for(3ms) == std::future_status::timeout)
			;
		if (other.get() != 42)
			complain("a future holds something else");
		std::this_thread::sleep_for(3ms);
	});
	for_ever("promise", [] {
		auto promise = std::make_shared<std::promise<std::string>>();
		auto future = promise->get_future();
		pool.submit([promise] { promise->set_value(data(100, 3)); });
		if (future.get() != data(100, 3))
			complain("a promise was not kept");
		std::this_thread::sleep_for(2ms);
	});
}

void start_turns()
{
	static std::mutex lock;
	static std::condition_variable turned;
	static long turn;
	static std::barrier<> meeting(3);
	static std::counting_semaphore<2> gate(2);
	static std::atomic<int> word;
	for (int me = 0; me < 3; me++) {
		for_ever("condition " + std::to_string(me), [me] {
			{
				std::unique_lock hold(lock);
				turned.wait(hold, [me] { return turn % 3 == me; });
				turn++;
				turned.notify_all();
			}
			std::this_thread::sleep_for(1ms);
		});
		for_ever("barrier " + std::to_string(me), [] {
			meeting.arrive_and_wait();
			std::this_thread::sleep_for(2ms);
		});
		for_ever("semaphore " + std::to_string(me), [] {
			gate.acquire();
			std::this_thread::sleep_for(1ms);
			gate.release();
		});
	}
	for (int me = 0; me < 2; me++)
		for_ever("atomic wait " + std::to_string(me), [me] {
			for (int seen; (seen = word) % 2 != me;)
				word.wait(seen);
			word++;
			word.notify_all();
			std::this_thread::sleep_for(1ms);
		});
	for_ever("latch", [] { // a thread that is made, waited for and joined
		std::latch done(1);
		std::jthread thread([&done] { done.count_down(); });
		done.wait();
		std::this_thread::sleep_for(3ms);
	});
}

std::string check()
{
	std::map<std::string, long> before;
	{
		std::lock_guard hold(books);
		for (auto &[name, n] : beats)
			before[name] = n;
	}
	auto deadline = std::chrono::steady_clock::now() + PATIENCE;
	for (;; std::this_thread::sleep_for(5ms)) {
		std::lock_guard hold(books);
		if (!wrong.empty())
			return "bad " + wrong.front();
		std::string still;
		for (auto &[name, n] : before)
			if (beats[name] < n + 2)
				still += " " + name;
		if (still.empty())
			break;
		if (std::chrono::steady_clock::now() > deadline)
			return "bad these stand still:" + still;
	}
	return "ok connections=" + std::to_string(connections) + " kinds=" + std::to_string(before.size());
}

std::string answer(std::istringstream &words)
{
	std::string what, name;
	words >> what;
	if (what == "inc") {
		words >> name;
		std::lock_guard hold(books);
		return std::to_string(++counters[name]);
	}
	if (what == "data") {
		int n;
		uint32_t seed;
		words >> n >> seed;
		std::string text = data(n, seed);
		char crc[9];
		snprintf(crc, sizeof crc, "%08x", crc32(text));
		return std::string(crc) + " " + text;
	}
	return check();
}

void serve(int fd)
{
	connections++;
	std::string received;
	char buffer[4096];
	for (ssize_t n; (n = read(fd, buffer, sizeof buffer)) > 0;) {
		received.append(buffer, static_cast<size_t>(n));
		for (size_t end; (end = received.find('\n')) != std::string::npos; received.erase(0, end + 1)) {
			std::istringstream words(received.substr(0, end));
			std::string id;
			words >> id;
			std::string reply = id + " " + answer(words) + "\n";
			for (size_t sent = 0; sent < reply.size();) {
				ssize_t m = write(fd, reply.data() + sent, reply.size() - sent);
				if (m < 0)
					goto gone;
				sent += static_cast<size_t>(m);
			}
		}
	}
gone:
	close(fd);
	connections--;
}

} // namespace

int main()
{
	signal(SIGPIPE, SIG_IGN);
	start_bank();
	start_queue();
	start_futures();
	start_turns();
	int listener = socket(AF_INET, SOCK_STREAM, 0), on = 1;
	setsockopt(listener, SOL_SOCKET, SO_REUSEADDR, &on, sizeof on);
	sockaddr_in address{};
	address.sin_family = AF_INET;
	address.sin_port = htons(7000);
	if (bind(listener, reinterpret_cast<sockaddr *>(&address), sizeof address) || listen(listener, 64)) {
		perror("port 7000");
		return 1;
	}
	for (;;) {
		int fd = accept(listener, nullptr, nullptr);
		if (fd < 0) {
			perror("accept");
			return 1;
		}
		setsockopt(fd, IPPROTO_TCP, TCP_NODELAY, &on, sizeof on);
		std::thread(serve, fd).detach();
	}
}
