// SPDX-License-Identifier: Apache-2.0
//
// A program with a fault in it, for bench/campaign.py:  faults FAULT PORT
//
// It computes a known series from what it keeps in memory, and sends each term with its number to
// 127.0.0.1:PORT, a hundred a second.  SIGUSR1 brings the fault out.
#include <arpa/inet.h>
#include <cassert>
#include <condition_variable>
#include <csignal>
#include <cstdint>
#include <cstdio>
#include <cstdlib>
#include <cstring>
#include <fcntl.h>
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

static void corrupt_heap()
{
	char *first = new char[24];

	// Glibc finds it when it looks at the chunk behind.
	memset(first, 0x41, 64);
	for (int i = 0; i < 64; i++)
		delete[] new char[24 + i * 16];
	delete[] first;
	free(malloc(100000));
}

static void use_after_free()
{
	Shape *dead = shape;

	delete dead;
	uint64_t *again = new uint64_t[sizeof(Shape) / 8];
	again[0] = 0x4141414141414141;
	sink = dead->area();
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

int main(int argc, char **argv)
{
	if (argc != 3)
		return 2;
	fault = argv[1];
	const bool watched = fault.find("own watchdog") != std::string::npos;
	const int out = socket(AF_INET, SOCK_DGRAM, 0);
	sockaddr_in to = {};
	uint64_t number = 0;
	std::vector<uint64_t> kept(1000);
	uint64_t *pointer = kept.data();
	int corrupted = 0, bad_at = 0;
	pid_t child = 0;

	to.sin_family = AF_INET;
	to.sin_port = htons(atoi(argv[2]));
	to.sin_addr.s_addr = htonl(INADDR_LOOPBACK);
	signal(SIGUSR1, on_trigger);
	srand(getpid());
	if (fault == "death of a child") {
		child = fork();
		if (!child)
			hang();
	}
	for (int seen = 0;;) {
		if (watched)
			alarm(2);
		kept[(number + 1) % 1000] = next_term(pointer[number % 1000]);
		number++;
		char text[64];
		const int length = snprintf(text, sizeof text, "%llu %llu", (unsigned long long)number,
					    (unsigned long long)pointer[number % 1000]);
		sendto(out, text, length, 0, (const sockaddr *)&to, sizeof to);
		if (child && waitpid(child, nullptr, WNOHANG) == child)
			exit(4);
		// Found only half a second after it has come about, with checkpoints in between.
		if (corrupted && ++bad_at == 50)
			sink = *(volatile int *)(uintptr_t)corrupted;
		if (seen != triggered) {
			seen = triggered;
			if (fault == "corruption before the checkpoint")
				corrupted = 8;
			else if (fault == "wrong value, no crash")
				kept[number % 1000] ^= 1u << 20;
			else if (fault == "death of a child")
				kill(child, SIGKILL);
			else if (fault == "the only thread ends")
				pthread_exit(nullptr);
			else if (fault == "fault in another thread")
				std::thread([] { sink = *null_pointer; }).detach();
			else
				break_down();
		}
		nap(10);
	}
}
