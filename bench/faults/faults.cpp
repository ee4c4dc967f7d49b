// SPDX-License-Identifier: Apache-2.0
//
// A program with a fault in it, for bench/campaign.py:  faults FAULT PORT
//
// It computes a known series from what it keeps in memory, and sends each term with its number to
// 127.0.0.1:PORT, a hundred a second.  SIGUSR1 brings the fault out.
//
// With -DROS it is a node of ROS 1, which computes in the callback of a timer and publishes on
// /terms_PORT; `faults relay PORT` is the node that hears it, and sends to PORT.
#include <arpa/inet.h>
#include <atomic>
#include <cassert>
#include <condition_variable>
#include <csignal>
#include <cstdint>
#include <cstdio>
#include <cstdlib>
#include <cstring>
#include <fcntl.h>
#include <functional>
#include <map>
#include <mutex>
#include <pthread.h>
#include <stdexcept>
#include <string>
#include <sys/mman.h>
#include <sys/resource.h>
#include <sys/socket.h>
#include <sys/wait.h>
#include <thread>
#include <unistd.h>
#include <vector>
#ifdef ROS
#include <ros/ros.h>
#include <std_msgs/String.h>
#endif

static volatile sig_atomic_t triggered;
static std::string fault;

static void on_trigger(int)
{
	triggered = triggered + 1;
}

static uint64_t next_term(uint64_t x)
{
	return x * 6364136223846793005u + 1442695040888963407u;
}

static void nap(int ms)
{
	usleep(ms * 1000);
}

struct Shape {
	virtual ~Shape() = default;
	virtual int area() { return 4; }
};

static volatile int *volatile null_pointer;
static volatile int zero, sink;
static Shape *volatile shape = new Shape;
static int (*volatile function)() = nullptr;

// As the compiler must not see that it ends nowhere.
__attribute__((noinline)) static int recurse(int n)
{
	volatile char frame[512];

	frame[0] = (char)n;
	return recurse(n + 1) + frame[0];
}

__attribute__((noinline)) static void smash(size_t size)
{
	char small[16];

	memset(small, 'A', size);
	sink = small[3];
}

static std::mutex one, other;
static std::condition_variable woken;
static bool work_is_there;
static std::map<int, int> shared_map;

// What it is sent, and does a part of with each term: by others, and by itself.
static int inputs[2], queue;
static sockaddr_in input_at;

static void open_inputs()
{
	int ends[2];
	socklen_t bytes = sizeof input_at;

	input_at.sin_family = AF_INET;
	input_at.sin_addr.s_addr = htonl(INADDR_LOOPBACK);
	inputs[0] = socket(AF_INET, SOCK_DGRAM | SOCK_NONBLOCK, 0);
	if (bind(inputs[0], (sockaddr *)&input_at, sizeof input_at) ||
	    getsockname(inputs[0], (sockaddr *)&input_at, &bytes) || pipe2(ends, O_NONBLOCK))
		abort();
	inputs[1] = ends[0];
	queue = ends[1];
}

static void take_input()
{
	char job = 0;

	for (const int input : inputs)
		if (read(input, &job, 1) == 1 && job == 'x')
			sink = *null_pointer;
}

static void send_bad_messages()
{
	for (int i = 0; i < 50; i++)
		sendto(inputs[0], "x", 1, 0, (sockaddr *)&input_at, sizeof input_at);
}

// A second and a half before the bad one is its turn.
static void queue_a_bad_job()
{
	const std::string jobs = std::string(150, '.') + "x";

	if (write(queue, jobs.data(), jobs.size()) < 0)
		abort();
}

// What one of them does for 2 ms the other must not do meanwhile.
static void meet_later()
{
	static std::atomic<int> inside;

	for (int t = 0; t < 2; t++)
		std::thread([] {
			nap(1500);
			if (inside++)
				sink = *null_pointer;
			nap(2);
			inside--;
		}).detach();
}

static void hang()
{
	for (;;)
		pause();
}

static void deadlock()
{
	std::thread([] {
		one.lock();
		nap(50);
		other.lock();
	}).detach();
	other.lock();
	nap(100);
	one.lock();
}

static void race()
{
	for (int t = 0; t < 2; t++)
		std::thread([t] {
			for (int i = 0; i < 3000000; i++) {
				shared_map[i % 64 + t] = i;
				shared_map.erase((i + 7) % 64);
			}
		}).detach();
}

static void truncate_mapped()
{
	const int fd = memfd_create("mapped", 0);

	if (ftruncate(fd, 8192))
		abort();
	auto *at = (volatile char *)mmap(nullptr, 8192, PROT_READ, MAP_SHARED, fd, 0);
	if (ftruncate(fd, 0))
		abort();
	sink = at[4096];
}

static void eat_memory()
{
	const rlimit limit = { 512u << 20, 512u << 20 };

	setrlimit(RLIMIT_DATA, &limit);
	for (;;)
		memset(new char[1 << 20], 1, 1 << 20);
}

static void leak_descriptors()
{
	const rlimit limit = { 256, 256 };

	setrlimit(RLIMIT_NOFILE, &limit);
	for (;;)
		if (open("/dev/null", O_RDONLY) < 0)
			throw std::runtime_error("out of descriptors");
}

static char *behind;

// Glibc finds it when the block behind is freed.
static void corrupt_heap()
{
	volatile char *first = new char[30000];

	behind = new char[30000];
	for (int i = 0; i < 30032; i++)
		first[i] = 0x41;
}

static void use_after_free()
{
	Shape *dead = shape;

	delete dead;
	uint64_t *again = new uint64_t[sizeof(Shape) / 8];
	again[0] = 0x4141414141414141;
	sink = dead->area();
}

static void overflow_disk()
{
	FILE *full = fopen("/dev/full", "w");

	if (fputs("result", full) < 0 || fclose(full))
		throw std::runtime_error("disk full");
}

static void write_to_nobody()
{
	int ends[2];

	if (pipe(ends))
		abort();
	close(ends[0]);
	sink = write(ends[1], "x", 1);
}

struct Base;
static void call_early(Base *base);
struct Base {
	Base() { call_early(this); }
	virtual ~Base() = default;
	virtual int area() = 0;
};
struct Derived : Base {
	int area() override { return 1; }
};
__attribute__((noinline)) static void call_early(Base *base)
{
	sink = base->area();
}

static void break_down()
{
	if (fault == "null pointer")
		sink = *null_pointer;
	else if (fault == "wild pointer")
		sink = *(volatile int *)0xdeadbeef000;
	else if (fault == "write to constant")
		*(volatile char *)"constant" = 1;
	else if (fault == "call through null")
		function();
	else if (fault == "use after free")
		use_after_free();
	else if (fault == "double free") {
		void *volatile p = malloc(40);
		free(p);
		free(p);
	} else if (fault == "heap corruption found later")
		corrupt_heap();
	else if (fault == "stack overflow")
		sink = recurse(0);
	else if (fault == "stack smashed")
		smash(256);
	else if (fault == "division by zero")
		sink = 1000 / zero;
	else if (fault == "illegal instruction")
		__builtin_trap();
	else if (fault == "assertion")
		abort();
	else if (fault == "uncaught exception")
		throw std::runtime_error("nobody catches this");
	else if (fault == "pure virtual call")
		delete new Derived;
	else if (fault == "huge allocation")
		sink = *new char[(size_t)1 << 60];
	else if (fault == "disk full")
		overflow_disk();
	else if (fault == "broken pipe")
		write_to_nobody();
	else if (fault == "timer without a handler")
		alarm(1);
	else if (fault == "index out of range")
		sink = std::vector<int>(3).at(7);
	else if (fault == "exit with a status")
		exit(3);
	else if (fault == "truncated mapped file")
		truncate_mapped();
	else if (fault == "memory leak to a limit")
		eat_memory();
	else if (fault == "descriptor leak")
		leak_descriptors();
	else if (fault == "race")
		race();
	else if (fault == "burst of bad messages")
		send_bad_messages();
	else if (fault == "bad job in a queue")
		queue_a_bad_job();
	else if (fault == "threads that meet")
		meet_later();
	else if (fault == "deadlock" || fault == "deadlock, own watchdog")
		deadlock();
	else if (fault == "livelock" || fault == "livelock, own watchdog")
		for (;;)
			sink = sink + 1;
	else if (fault == "lost wake-up" || fault == "lost wake-up, own watchdog") {
		std::unique_lock<std::mutex> lock(one);
		woken.wait(lock, [] { return work_is_there; });
	} else if (fault == "hang in a callback" || fault == "hang in a callback, own watchdog")
		hang();
	else if (fault == "killed from outside")
		raise(SIGKILL);
	else if (fault == "poison input" || (fault == "poison input, one in four" && rand() % 4 == 0))
		sink = *null_pointer;
}

// The series, a term at a time, until it is told to break down.
class Program {
public:
	Program(std::function<void(const std::string &)> send, bool watched)
		: send_(std::move(send)), watched_(watched)
	{
		if (fault == "death of a child") {
			child_ = fork();
			if (!child_)
				hang();
		}
	}

	// Whether there is another one.
	bool step()
	{
		if (watched_)
			alarm(2);
		take_input();
		kept_[(number_ + 1) % 1000] = next_term(pointer_[number_ % 1000]);
		number_++;
		send_(std::to_string(number_) + " " + std::to_string(pointer_[number_ % 1000]));
		if (child_ && waitpid(child_, nullptr, WNOHANG) == child_)
			exit(4);
		// Found only half a second after it has come about, with checkpoints in between.
		if (corrupted_ && ++bad_at_ == 50)
			sink = *(volatile int *)(uintptr_t)corrupted_;
		if (behind && ++bad_at_ == 10)
			delete[] behind;
		if (leaks_)
			memset(new char[1 << 20], 1, 1 << 20);
		if (seen_ == triggered)
			return true;
		seen_ = triggered;
		if (fault == "corruption before the checkpoint")
			corrupted_ = 8;
		else if (fault == "wrong value, no crash")
			kept_[number_ % 1000] ^= 1u << 20;
		else if (fault == "memory leak to the OOM killer")
			leaks_ = true;
		else if (fault == "death of a child")
			kill(child_, SIGKILL);
		else if (fault == "the only thread ends")
			pthread_exit(nullptr);
		else if (fault == "fault in another thread")
			std::thread([] { sink = *null_pointer; }).detach();
		else if (ends_silently())
			return false;
		else
			break_down();
		return true;
	}

	static bool ends_silently() { return fault.rfind("death of a thread", 0) == 0; }

private:
	std::function<void(const std::string &)> send_;
	bool watched_, leaks_ = false;
	uint64_t number_ = 0;
	std::vector<uint64_t> kept_ = std::vector<uint64_t>(1000);
	uint64_t *pointer_ = kept_.data();
	int corrupted_ = 0, bad_at_ = 0, seen_ = 0;
	pid_t child_ = 0;
};

static std::function<void(const std::string &)> sender(const char *port)
{
	const int out = socket(AF_INET, SOCK_DGRAM, 0);
	sockaddr_in to = {};

	to.sin_family = AF_INET;
	to.sin_port = htons(atoi(port));
	to.sin_addr.s_addr = htonl(INADDR_LOOPBACK);
	return [out, to](const std::string &text) {
		sendto(out, text.data(), text.size(), 0, (const sockaddr *)&to, sizeof to);
	};
}

#ifdef ROS

static int run(const char *port, bool watched)
{
	ros::NodeHandle node;

	if (fault == "relay") {
		const auto send = sender(port);
		const auto hear = [&](const std_msgs::String::ConstPtr &term) { send(term->data); };
		const ros::Subscriber terms = node.subscribe<std_msgs::String>(
			std::string("/terms_") + port, 100, hear);
		ros::spin();
		return 0;
	}
	const ros::Publisher terms =
		node.advertise<std_msgs::String>(std::string("/terms_") + port, 100);
	Program program(
		[&](const std::string &text) {
			std_msgs::String term;
			term.data = text;
			terms.publish(term);
		},
		watched);
	ros::WallTimer timer;
	timer = node.createWallTimer(ros::WallDuration(0.01), [&](const ros::WallTimerEvent &) {
		if (!program.step())
			timer.stop();
	});
	ros::spin();
	return 0;
}

#else

static int run(const char *port, bool watched)
{
	Program program(sender(port), watched);
	const auto work = [&] {
		while (program.step())
			nap(10);
	};

	if (Program::ends_silently())
		std::thread(work).join();
	else
		work();
	hang();
	return 0;
}

#endif

int main(int argc, char **argv)
{
	if (argc < 3)
		return 2;
#ifdef ROS
	ros::init(argc, argv, std::string(argv[1] == std::string("relay") ? "relay_" : "faults_") + argv[2]);
#endif
	fault = argv[1];
	signal(SIGUSR1, on_trigger);
	srand(getpid());
	open_inputs();
	return run(argv[2], fault.find("own watchdog") != std::string::npos);
}
