// SPDX-License-Identifier: Apache-2.0

// A program with a fault in it, as faults.cpp: faults FAULT PORT
package main

import (
	"bytes"
	"fmt"
	"math/rand"
	"net"
	"os"
	"os/signal"
	"runtime/debug"
	"strings"
	"sync"
	"sync/atomic"
	"syscall"
	"time"
)

var (
	triggered int32
	nothing   *int
	zero      int
	shared    = map[int]int{}
)

func recurse(n int) int {
	return recurse(n+1) + 1
}

func hang() {
	var lock sync.Mutex
	lock.Lock()
	lock.Lock()
}

func breakDown(fault string) {
	switch {
	case fault == "null pointer":
		fmt.Println(*nothing)
	case fault == "index out of range":
		fmt.Println(make([]int, 3)[7+zero])
	case fault == "division by zero":
		fmt.Println(1 / zero)
	case fault == "uncaught exception":
		panic("nobody recovers from this")
	case fault == "stack overflow":
		debug.SetMaxStack(64 << 20)
		fmt.Println(recurse(0))
	case fault == "exit with a status":
		os.Exit(3)
	case fault == "disk full":
		if err := os.WriteFile("/dev/full", []byte("result"), 0o600); err != nil {
			panic(err)
		}
	case fault == "race":
		for t := 0; t < 2; t++ {
			go func() {
				for i := 0; ; i++ {
					shared[i%64] = i
				}
			}()
		}
	case fault == "descriptor leak":
		limit := syscall.Rlimit{Cur: 256, Max: 256}
		syscall.Setrlimit(syscall.RLIMIT_NOFILE, &limit)
		for {
			if _, err := syscall.Open("/dev/null", syscall.O_RDONLY, 0); err != nil {
				panic(err)
			}
		}
	case strings.HasPrefix(fault, "deadlock"), strings.HasPrefix(fault, "lost wake-up"):
		hang()
	case strings.HasPrefix(fault, "livelock"):
		for {
			zero = 0
		}
	case fault == "killed from outside":
		syscall.Kill(syscall.Getpid(), syscall.SIGKILL)
	case fault == "fault in another thread":
		go func() { fmt.Println(*nothing) }()
	case fault == "poison input", fault == "poison input, one in four" && rand.Intn(4) == 0:
		panic("poison")
	}
}

func main() {
	fault := os.Args[1]
	out, err := net.Dial("udp", "127.0.0.1:"+os.Args[2])
	if err != nil {
		panic(err)
	}
	rand.Seed(time.Now().UnixNano())
	signals := make(chan os.Signal, 8)
	signal.Notify(signals, syscall.SIGUSR1)
	go func() {
		for range signals {
			atomic.AddInt32(&triggered, 1)
		}
	}()
	work := func() {
		kept := make([]uint64, 1000)
		seen, bad := int32(0), 0
		var leaked [][]byte
		for number := uint64(1); ; number++ {
			kept[number%1000] = kept[(number-1)%1000]*6364136223846793005 + 1442695040888963407
			fmt.Fprintf(out, "%d %d", number, kept[number%1000])
			if bad > 0 {
				if bad--; bad == 0 {
					fmt.Println(*nothing)
				}
			}
			if leaked != nil {
				leaked = append(leaked, bytes.Repeat([]byte{1}, 1<<20))
			}
			if now := atomic.LoadInt32(&triggered); now != seen {
				seen = now
				switch fault {
				case "corruption before the checkpoint":
					bad = 50
				case "wrong value, no crash":
					kept[number%1000] ^= 1 << 20
				case "memory leak to the OOM killer":
					leaked = [][]byte{}
				case "death of a thread":
					return
				default:
					breakDown(fault)
				}
			}
			time.Sleep(10 * time.Millisecond)
		}
	}
	go work()
	select {}
}
