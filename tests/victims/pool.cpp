// SPDX-License-Identifier: Apache-2.0
//
// pool WORKERS MB: what C++ programs are made of, all at once, for as long as it runs.
//
// A thread pool with a queue of tasks and their futures, exceptions that travel
// through them, a bounded channel with condition variables and time limits,
// accounts under several locks whose sum stays, threads of std::async that come
// and go, and descriptors that are opened and closed.  Every result is checked
// against what it must be.  It needs the same of everything after an hour as
// after a minute: whatever grows is somebody's leak.
#include <sys/eventfd.h>

#include <array>
#include <atomic>
#include <chrono>
#include <condition_variable>
#include <deque>
#include <future>
#include <memory>
#include <mutex>
#include <shared_mutex>
#include <stdexcept>
#include <string>
#include <thread>
#include <vector>

#include "victim.h"

namespace
{

using namespace std::chrono_literals;

constexpr int ACCOUNTS = 16, MONEY = 1000;
constexpr size_t CHANNEL_ROOM = 8;
constexpr auto PATIENCE = 30s;

/// Counters of the board.
enum { TASKS, EXCEPTIONS, RECEIVED, TRANSFERS, ASYNCS, TIMEOUTS };

class Pool
{
      public:
	explicit Pool(size_t workers)
	{
		for (size_t i = 0; i < workers; i++)
			threads.emplace_back([this] { work(); });
	}

	template <class F> auto submit(F work)
	{
		std::packaged_task<std::invoke_result_t<F>()> task(std::move(work));
		auto result = task.get_future();
		{
			std::lock_guard hold(lock);
			tasks.emplace_back(std::move(task));
		}
		filled.notify_one();
		return result;
	}

      private:
	/// What std::function cannot hold: a packaged_task, which only moves.
	struct Task {
		struct Base {
			virtual ~Base() = default;
			virtual void run() = 0;
		};
		template <class T> struct Of : Base {
			explicit Of(T of) : task(std::move(of))
			{
			}
			void run() override
			{
				task();
			}
			T task;
		};
		template <class T> explicit Task(T task) : held(new Of<T>(std::move(task)))
		{
		}
		std::unique_ptr<Base> held;
	};

	[[noreturn]] void work()
	{
		const auto self = std::this_thread::get_id();
		const auto tid = syscall(SYS_gettid);

		for (;;) {
			std::unique_lock hold(lock);
			if (!filled.wait_for(hold, 10ms, [this] { return !tasks.empty(); })) {
				count(TIMEOUTS, 1);
				continue;
			}
			Task task = std::move(tasks.front());
			tasks.pop_front();
			hold.unlock();
			task.held->run();
			count(TASKS, 1);
			CHECK(std::this_thread::get_id() == self, "a worker is another thread");
			CHECK(syscall(SYS_gettid) == tid, "a worker was thread %ld", tid);
		}
	}

	std::mutex lock;
	std::condition_variable filled;
	std::deque<Task> tasks;
	std::vector<std::thread> threads;
};

/// Numbers in order from one thread to another; neither lost nor twice.
class Channel
{
      public:
	Channel() : sender([this] { send(); }), receiver([this] { receive(); })
	{
	}

      private:
	[[noreturn]] void send()
	{
		for (uint64_t n = 0;; n++) {
			std::unique_lock hold(lock);
			CHECK(taken.wait_for(hold, PATIENCE,
					     [this] { return held.size() < CHANNEL_ROOM; }),
			      "nobody takes from the channel");
			held.push_back(n);
			hold.unlock();
			put.notify_one();
			if (n % 64 == 0)
				std::this_thread::sleep_for(4ms);
		}
	}

	[[noreturn]] void receive()
	{
		for (uint64_t n = 0;; n++) {
			std::unique_lock hold(lock);
			CHECK(put.wait_for(hold, PATIENCE, [this] { return !held.empty(); }),
			      "nobody puts into the channel");
			CHECK(held.front() == n, "the channel brings %lu after %lu", held.front(),
			      n - 1);
			held.pop_front();
			hold.unlock();
			taken.notify_one();
			count(RECEIVED, 1);
		}
	}

	std::mutex lock;
	std::condition_variable put, taken;
	std::deque<uint64_t> held;
	std::thread sender, receiver;
};

struct Account {
	std::mutex lock;
	int money = MONEY;
};

std::array<Account, ACCOUNTS> accounts;
std::shared_mutex audit;

void transfer(uint64_t random)
{
	Account &from = accounts[random % ACCOUNTS];
	Account &to = accounts[random / ACCOUNTS % ACCOUNTS];

	if (&from == &to)
		return;
	std::shared_lock pass(audit);
	std::scoped_lock both(from.lock, to.lock);
	from.money -= 7;
	std::this_thread::yield();
	to.money += 7;
	count(TRANSFERS, 1);
}

void check_accounts()
{
	std::unique_lock alone(audit);
	int sum = 0;

	for (const Account &account : accounts)
		sum += account.money;
	CHECK(sum == ACCOUNTS * MONEY, "the accounts have %d instead of %d", sum, ACCOUNTS * MONEY);
}

uint64_t triangle(uint64_t n)
{
	uint64_t sum = 0;

	for (uint64_t i = 1; i <= n; i++)
		sum += i;
	return sum;
}

template <class T> T patient(std::future<T> future, const char *of)
{
	CHECK(future.wait_for(PATIENCE) == std::future_status::ready, "no result of %s", of);
	return future.get();
}

/// Futures, exceptions through futures, and tasks that wait for tasks' results.
void use(Pool &pool, uint64_t round)
{
	std::vector<std::future<uint64_t>> results;

	for (uint64_t i = 0; i < 20; i++) {
		results.push_back(pool.submit([i] { return triangle(100 * i); }));
		pool.submit([n = mix(round, i)] { transfer(n); });
	}
	auto failing = pool.submit([round]() -> int { throw std::out_of_range(std::to_string(round)); });
	try {
		patient(std::move(failing), "a task that throws");
		violation("an exception was lost");
	} catch (const std::out_of_range &error) {
		CHECK(error.what() == std::to_string(round), "the exception says %s in round %lu",
		      error.what(), round);
		count(EXCEPTIONS, 1);
	}
	for (uint64_t i = 0; i < results.size(); i++) {
		const uint64_t result = patient(std::move(results[i]), "a task");
		CHECK(result == triangle(100 * i), "task %lu brought %lu", i, result);
	}
}

/// A thread that is made, waited for, and gone.
void go_async(uint64_t round)
{
	std::promise<uint64_t> question;
	auto answer = std::async(std::launch::async, [asked = question.get_future()]() mutable {
		return mix(asked.get(), 1);
	});

	question.set_value(round);
	CHECK(patient(std::move(answer), "a thread") == mix(round, 1), "a wrong answer");
	count(ASYNCS, 1);
}

/// Descriptors and memory come and go.
void churn(uint64_t round)
{
	std::vector<uint64_t> block(1000 + round % 50 * 2000, round);
	int ends[2], event = eventfd(0, EFD_CLOEXEC), null = open("/dev/null", O_RDWR | O_CLOEXEC);
	uint64_t got = 0;

	CHECK(event >= 0 && null >= 0 && pipe2(ends, O_CLOEXEC) == 0, "no descriptors: %s",
	      strerror(errno));
	CHECK(write(ends[1], &round, sizeof round) == sizeof round, "cannot write to a pipe");
	CHECK(read(ends[0], &got, sizeof got) == sizeof got && got == round,
	      "a pipe brought %lu in round %lu", got, round);
	CHECK(block.front() == round && block.back() == round, "a block of another round");
	for (int fd : { ends[0], ends[1], event, null })
		close(fd);
}

} // namespace

int main(int argc, char **argv)
{
	victim_start(&argc, argv, 2, "WORKERS MB");
	const size_t words = static_cast<size_t>(atol(argv[2])) << 17;
	std::vector<uint64_t> memory(words);
	Pool pool(static_cast<size_t>(atol(argv[1])));
	Channel channel;

	for (size_t i = 0; i < words; i++)
		memory[i] = mix(i, 0);
	for (uint64_t round = 0;; round++) {
		const size_t part = round % 64;

		use(pool, round);
		go_async(round);
		churn(round);
		check_accounts();
		/* A part is written, and was last written 64 rounds ago. */
		for (size_t i = part * words / 64; i < (part + 1) * words / 64; i += 64) {
			CHECK(memory[i] == mix(i, round / 64), "word %zu is not of round %lu", i,
			      round - 64);
			memory[i] = mix(i, round / 64 + 1);
		}
		if (round == 100)
			victim_ready();
		beat();
		std::this_thread::sleep_for(4ms);
	}
}
