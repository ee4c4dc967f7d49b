// SPDX-License-Identifier: Apache-2.0
//
// The same sum again and again, by the threads of OpenMP (-fopenmp) or of TBB (-DTBB -ltbb).
// Prints "step N" for each that is right, else "WRONG".
#include <chrono>
#include <cstdint>
#include <cstdio>
#include <thread>
#include <vector>

#ifdef TBB
#include <tbb/blocked_range.h>
#include <tbb/parallel_reduce.h>
#endif

static std::uint64_t sum(const std::vector<std::uint32_t> &numbers)
{
#ifdef TBB
	using range = tbb::blocked_range<std::size_t>;

	return tbb::parallel_reduce(
		range(0, numbers.size(), 1000), std::uint64_t{ 0 },
		[&](const range &part, std::uint64_t total) {
			for (std::size_t i = part.begin(); i != part.end(); i++)
				total += numbers[i];
			return total;
		},
		[](std::uint64_t a, std::uint64_t b) { return a + b; });
#else
	std::uint64_t total = 0;

#pragma omp parallel for reduction(+ : total) num_threads(4)
	for (std::size_t i = 0; i < numbers.size(); i++)
		total += numbers[i];
	return total;
#endif
}

int main()
{
	std::vector<std::uint32_t> numbers(4 << 20);
	std::uint64_t expected = 0;

	for (std::size_t i = 0; i < numbers.size(); i++)
		expected += numbers[i] = static_cast<std::uint32_t>(i * 2654435761u);
	for (unsigned n = 0;; n++) {
		if (sum(numbers) == expected)
			std::printf("step %u\n", n);
		else
			std::puts("WRONG");
		std::fflush(stdout);
		std::this_thread::sleep_for(std::chrono::milliseconds(20));
	}
}
